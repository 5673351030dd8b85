"""Numerical check of a factor's Jacobian, through GTSAM's own linearisation.

The check sees what the optimiser sees: keys in order, whitening, retraction. It works for any `NonlinearFactor`,
custom or native, with a noise model that is not robust (a robust weight is held fixed in GTSAM's linearisation).
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

import gtsam
import numpy as np

import factors

Example = tuple[str, gtsam.NonlinearFactor, gtsam.Values]


def whitened_error(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> np.ndarray:
    """Whitened residual of a factor, shape (rows,)."""
    return -np.asarray(factor.linearize(values).jacobian()[1])


def jacobian_error(factor: gtsam.NonlinearFactor, values: gtsam.Values, step: float = 1e-5) -> float:
    """Largest difference between analytic and central-difference Jacobian, relative to the largest entry.

    Args:
        factor: any factor whose variables are in `values`.
        values: the point of linearisation.
        step: of the central difference, in tangent units.
    """
    analytic = np.asarray(factor.linearize(values).jacobian()[0])
    numeric = np.empty_like(analytic)
    column = 0
    zero = values.zeroVectors()
    for key in factor.keys():
        dimension = zero.at(key).size
        for axis in range(dimension):
            delta = np.zeros(dimension)
            delta[axis] = step
            numeric[:, column] = (
                whitened_error(factor, _moved(values, key, delta)) - whitened_error(factor, _moved(values, key, -delta))
            ) / (2 * step)
            column += 1
    return float(np.abs(analytic - numeric).max() / max(1.0, np.abs(numeric).max()))


def examples(seed: int = 0) -> Iterator[Example]:
    """The examples of every file of the package that offers some, so that a new factor is checked for free."""
    for module in sorted(info.name for info in pkgutil.iter_modules(factors.__path__)):
        offered = getattr(importlib.import_module(f"factors.{module}"), "examples", None)
        if offered is not None and module != "jacobian_check":
            for label, factor, values in offered(np.random.default_rng(seed)):
                yield f"{module}: {label}", factor, values


def _moved(values: gtsam.Values, key: int, delta: np.ndarray) -> gtsam.Values:
    step = gtsam.VectorValues()
    step.insert(key, delta)
    return values.retract(step)
