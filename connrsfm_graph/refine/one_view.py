"""Levenberg-Marquardt on the cost of views one by one, lengths held, in compiled code.

A view's matrix is made, factored and forgotten while it is at hand, so that the memory does not grow with the views.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from connrsfm_graph.refine.arcs import arc_offsets
from connrsfm_graph.refine.cost import linearise_view, view_cost
from connrsfm_graph.refine.envelope import factor_damped, substitute


@njit(cache=True, inline="always")
def _place(image, log_depth, correction, X):
    """Points of one view into X (P, 3)."""
    for i in range(len(X)):
        depth = np.exp(log_depth[i])
        X[i, 0] = depth * (image[i, 0] + correction[i, 0])
        X[i, 1] = depth * (image[i, 1] + correction[i, 1])
        X[i, 2] = depth


@njit(cache=True, inline="always")
def _offset(X, edges, triangles, splines, v, conformal, stretch, offset):
    """What is added to the log chords of view v, into `offset` (E,)."""
    if conformal:
        offset[:] = 0.0
    else:
        columns, rows, smoothing = splines
        arc_offsets(X, edges, triangles, columns[v], rows[v], smoothing[v], offset)
    offset -= stretch


@njit(cache=True, nogil=True)
def fit_views_kernel(
    first, last, image, image_weight, anchor, length_weight, factor_weight, triangles, splines, stretch, terms,
    envelope, iterations, tolerance, exact, damping_range, log_depth, correction, log_factor, cost,
):  # fmt: skip
    """Fit views first to last - 1.

    Args:
        image, image_weight, length_weight, factor_weight: as in `measurements.Measurements`.
        anchor: (F, P) log depths about which those of the shape may drift.
        triangles: (T, 3) of the mesh.
        splines: what views are smoothed by before arcs are measured over them.
        stretch: (F, E) changes of log lengths in the views.
        terms: what all views share.
        envelope: storage of a view's matrix.
        iterations: at most so many.
        tolerance: a view's fit ends where an iteration lowers its cost by less than this part of it,
        exact: or to less than this.
        damping_range: first, smallest and largest damping.
        log_depth, correction, log_factor: the start, replaced by the minimum.
        cost: output (F,).
    """
    P, E, n = len(image[0]), len(terms.edges), len(envelope.first)
    conformal = log_factor.shape[1] > 0
    X, offset = np.empty((P, 3)), np.zeros(E)
    matrix, step, border = np.empty(envelope.start[-1]), np.empty(n), np.empty((E, 2 * (n // P)))
    residual, weight = np.empty(E), np.empty(E)
    new_depth, new_correction, new_factor = np.empty(P), np.empty((P, 2)), np.empty(log_factor.shape[1])
    for v in range(first, last):
        b, q, f = log_depth[v], correction[v], log_factor[v]
        of_view = (image_weight[v], length_weight[v], factor_weight[v], terms)
        damping = damping_range[0]
        for _ in range(iterations):
            _place(image[v], b, q, X)
            _offset(X, terms.edges, triangles, splines, v, conformal, stretch[v], offset)
            before = view_cost(X, f, b - anchor[v], offset, q, *of_view)
            linearise_view(X, f, b - anchor[v], offset, q, *of_view, envelope, matrix, step, border, residual, weight)
            after = np.inf
            if factor_damped(matrix, damping, envelope.first, envelope.start):
                substitute(matrix, envelope.first, envelope.start, step)
                for i in range(P):
                    at = envelope.unknown[i]
                    new_depth[i] = b[i] - step[at]
                    new_correction[i, 0] = q[i, 0] - step[at + 1]
                    new_correction[i, 1] = q[i, 1] - step[at + 2]
                    if conformal:
                        new_factor[i] = f[i] - step[at + 3]
                _place(image[v], new_depth, new_correction, X)
                after = view_cost(X, new_factor, new_depth - anchor[v], offset, new_correction, *of_view)
            if not after <= before:  # nor a number
                damping = min(10.0 * damping, damping_range[2])
                continue
            b[:], q[:], f[:] = new_depth, new_correction, new_factor
            damping = max(0.1 * damping, damping_range[1])
            if before - after <= tolerance * before or after <= exact:
                break
        _place(image[v], b, q, X)
        _offset(X, terms.edges, triangles, splines, v, conformal, stretch[v], offset)
        cost[v] = view_cost(X, f, b - anchor[v], offset, q, *of_view)
