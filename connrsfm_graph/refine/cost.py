"""The refinement's cost in one view, and its linearisation, from the kernels of `factors`.

Unknowns of a view, in this order per point: log depth b, ray correction q (2) and, in conformal use, the log
conformal factor f. Latent log lengths are shared by all views. "Lagged" quantities, the
hinge coefficients and the ratios of arc to chord, are functions of the shape that are held fixed in its derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from factors.bending import hinge_coefficients
from factors.edge_length import log_chord_kernel
from factors.frontal import log_foreshortening_kernel

BENDING_CAP = 6.0
"""A hinge's coefficients are scaled down to at most this times their median: slivers carry no curvature."""


class Weights(NamedTuple):
    """Inverse standard deviations. A named tuple, since compiled code takes it as it is."""

    huber: float
    """Length residuals beyond this many standard deviations count linearly."""
    bending: float
    """Of the hinge residual; 0 switches bending off."""
    smoothness: float
    """Of differences of the log conformal factor over near edges."""
    drift: float
    """Of log depths about their start; weak, it keeps points that nothing else holds from leaving for infinity."""
    unit: float
    """Of the mean log length; it fixes the unit of length."""


class Terms(NamedTuple):
    """What is common to all views: the mesh's terms and their shared variables."""

    edges: np.ndarray
    """(E, 2)."""
    n_near: int
    """The first edges, also those of the scale's smoothness."""
    hinges: np.ndarray
    """(H, 4)."""
    stencils: np.ndarray
    """(H, 4) hinge coefficients."""
    log_length: np.ndarray
    """(E,) latent log lengths."""
    frontal: np.ndarray
    """(E,) cost of an edge's log foreshortening in a view; zero where slants are not assumed small."""
    weights: Weights
    """See there."""


@njit(cache=True)
def hinge_stencils(length, hinge_edges, coefficients):
    """Coefficients (H, 4) of all hinges from the edge lengths (E,), slivers capped."""
    size = np.empty(len(hinge_edges))
    for h in range(len(hinge_edges)):
        e = hinge_edges[h]
        c = hinge_coefficients(length[e[0]], length[e[1]], length[e[2]], length[e[3]], length[e[4]])
        size[h] = 0.0
        for j in range(4):
            coefficients[h, j] = c[j]
            size[h] = max(size[h], abs(c[j]))
    if len(size) == 0:
        return
    cap = BENDING_CAP * np.median(size)
    for h in range(len(size)):
        if size[h] > cap:
            for j in range(4):
                coefficients[h, j] *= cap / size[h]


@njit(cache=True)
def view_cost(X, f, drift, offset, correction, image_weight, length_weight, factor_weight, terms):
    """Half the robust weighted sum of squares of one view, and what its foreshortening costs.

    Args:
        X: (P, 3) points of the view.
        f: (P,) log conformal factors, or (0,) in isometric use.
        drift: (P,) log depth minus that of the start.
        offset: (E,) log ratio of arc to chord.
        correction: (P, 2) ray corrections.
        image_weight: (P,) inverse standard deviation of the image points.
        length_weight: (E,) inverse standard deviation of the log length residuals.
        factor_weight: inverse standard deviation of the log conformal factors.
        terms: what all views share.
    """
    edges, n_near, hinges, stencils, log_length, frontal, weights = terms
    conformal = len(f) > 0
    total = 0.0
    for e in range(len(edges)):
        i, k = edges[e, 0], edges[e, 1]
        r = log_chord_kernel(X[i, 0], X[i, 1], X[i, 2], X[k, 0], X[k, 1], X[k, 2])[0] + offset[e] - log_length[e]
        if conformal:
            r -= 0.5 * (f[i] + f[k])
            if e < n_near:
                total += 0.5 * (weights.smoothness * (f[i] - f[k])) ** 2
        r = abs(r * length_weight[e])
        total += 0.5 * r * r if r <= weights.huber else weights.huber * (r - 0.5 * weights.huber)
        if frontal[e] > 0.0:
            u = X[i, 0] / X[i, 2] - correction[i, 0] - X[k, 0] / X[k, 2] + correction[k, 0]
            v = X[i, 1] / X[i, 2] - correction[i, 1] - X[k, 1] / X[k, 2] + correction[k, 1]
            b_i, b_k = np.log(X[i, 2]), np.log(X[k, 2])
            total += frontal[e] * log_foreshortening_kernel(u, v, b_i, b_k, log_length[e])
    for i in range(len(X)):
        total += 0.5 * (weights.drift * drift[i]) ** 2
        total += 0.5 * image_weight[i] ** 2 * (correction[i, 0] ** 2 + correction[i, 1] ** 2)
        if conformal:
            total += 0.5 * (factor_weight * f[i]) ** 2
    if weights.bending > 0.0:
        for h in range(len(hinges)):
            for a in range(3):
                r = 0.0
                for j in range(4):
                    r += stencils[h, j] * X[hinges[h, j], a]
                total += 0.5 * (weights.bending * r) ** 2
    return total


@njit(cache=True)
def linearise_view(
    X, f, drift, offset, correction, image_weight, length_weight, factor_weight, terms, envelope,
    matrix, gradient, border, residual, inverse_variance,
):  # fmt: skip
    """Normal equations of one view; arguments before `envelope` as in `view_cost`.

    Args:
        envelope: storage of the matrix (see `envelope`).
        matrix: output (N,), lower triangle.
        gradient: output (n,).
        border: output (E, 2 m): derivative of each length residual by the unknowns of its two ends.
        residual: output (E,) length residuals.
        inverse_variance: output (E,) their weights, robust loss included.
    """
    edges, n_near, hinges, stencils, log_length, frontal, weights = terms
    conformal = len(f) > 0
    m = 4 if conformal else 3
    row = envelope.start[:-1] - envelope.first
    unknown = envelope.unknown
    matrix[:] = 0.0
    gradient[:] = 0.0
    at = np.empty(12, dtype=np.int64)
    J = np.empty(12)
    for e in range(len(edges)):
        i, k = edges[e, 0], edges[e, 1]
        chord = log_chord_kernel(X[i, 0], X[i, 1], X[i, 2], X[k, 0], X[k, 1], X[k, 2])
        r = chord[0] + offset[e] - log_length[e]
        for c in range(3):
            at[c], at[m + c] = unknown[i] + c, unknown[k] + c
            J[c], J[m + c] = chord[1 + c], chord[4 + c]
        if conformal:
            r -= 0.5 * (f[i] + f[k])
            at[3], at[7] = unknown[i] + 3, unknown[k] + 3
            J[3], J[7] = -0.5, -0.5
            if e < n_near:
                w = weights.smoothness**2
                matrix[row[at[3]] + at[3]] += w
                matrix[row[at[7]] + at[7]] += w
                matrix[row[max(at[3], at[7])] + min(at[3], at[7])] -= w
                gradient[at[3]] += w * (f[i] - f[k])
                gradient[at[7]] += w * (f[k] - f[i])
        w = length_weight[e] ** 2
        size = abs(r) * length_weight[e]
        if size > weights.huber:
            w *= weights.huber / size
        residual[e], inverse_variance[e] = r, w
        for c in range(2 * m):
            border[e, c] = J[c]
        _add_row(matrix, row, gradient, at, J, 2 * m, w, r)
        gradient[at[0]] -= 0.5 * frontal[e]
        gradient[at[m]] -= 0.5 * frontal[e]
    for i in range(len(X)):
        n = unknown[i]
        matrix[row[n] + n] += weights.drift**2
        gradient[n] += weights.drift**2 * drift[i]
        w = image_weight[i] ** 2
        for c in range(2):
            n = unknown[i] + 1 + c
            matrix[row[n] + n] += w
            gradient[n] += w * correction[i, c]
        if conformal:
            n = unknown[i] + 3
            matrix[row[n] + n] += factor_weight**2
            gradient[n] += factor_weight**2 * f[i]
    if weights.bending > 0.0:
        w = weights.bending**2
        for h in range(len(hinges)):
            for a in range(3):
                r = 0.0
                n = 0
                for j in range(4):
                    p = hinges[h, j]
                    r += stencils[h, j] * X[p, a]
                    at[n], J[n] = unknown[p], stencils[h, j] * X[p, a]
                    n += 1
                    if a < 2:
                        at[n], J[n] = unknown[p] + 1 + a, stencils[h, j] * X[p, 2]
                        n += 1
                _add_row(matrix, row, gradient, at, J, n, w, r)


@njit(cache=True, inline="always")
def _add_row(matrix, row, gradient, at, J, n, w, r):
    for a in range(n):
        gradient[at[a]] += w * r * J[a]
        for b in range(n):
            if at[a] >= at[b]:
                matrix[row[at[a]] + at[b]] += w * J[a] * J[b]


@njit(cache=True, nogil=True)
def cost_kernel(first, last, X, f, drift, offset, correction, image_weight, length_weight, factor_weight, terms, cost):
    """Cost of views first to last - 1 into `cost` (F,); arguments as in `view_cost`, with a dimension for views."""
    for v in range(first, last):
        cost[v] = view_cost(
            X[v], f[v], drift[v], offset[v], correction[v], image_weight[v], length_weight[v], factor_weight[v], terms
        )


@njit(cache=True, nogil=True)
def linearise_kernel(
    first, last, X, f, drift, offset, correction, image_weight, length_weight, factor_weight, terms, envelope,
    matrix, gradient, border, residual, inverse_variance,
):  # fmt: skip
    """Normal equations of views first to last - 1; arguments as in `linearise_view`, with a dimension for views."""
    for v in range(first, last):
        linearise_view(
            X[v], f[v], drift[v], offset[v], correction[v], image_weight[v], length_weight[v], factor_weight[v], terms,
            envelope, matrix[v], gradient[v], border[v], residual[v], inverse_variance[v],
        )  # fmt: skip
