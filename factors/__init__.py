"""Factors of non-rigid structure from motion: geometry kernels and their GTSAM adapters.

One factor is one file: a compiled kernel that returns residual and Jacobian, and a thin adapter that makes a
`gtsam.NonlinearFactor` of it. The package knows no pipeline, no files and no plots; it imports numpy, numba and
gtsam only. To add a factor, add a file with a kernel, a constructor and a function `examples(rng)` that yields
`(label, factor, values)`: the Jacobian check of the test suite finds it by that name (see `jacobian_check`).
"""
