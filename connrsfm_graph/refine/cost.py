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
from factors.edge_length import arc_offset, log_chord_kernel

BENDING_CAP = 6.0
"""A hinge's coefficients are scaled down to at most this times their median: slivers carry no curvature."""

QUADRIC_RIDGE = 1e-2
"""Keeps the quadric about a vertex flat where it has too few neighbours to show its curvature."""


class Weights(NamedTuple):
    """Inverse standard deviations. A named tuple, since compiled code takes it as it is."""

    huber: float
    """Length residuals beyond this many standard deviations count linearly."""
    bending: float
    """Of the hinge residual; 0 switches bending off."""
    smoothness: float
    """Of differences of the log conformal factor over near edges."""
    factor: float
    """Of the log conformal factor itself; weak, it fixes the mean."""
    unit: float
    """Of the mean log length; it fixes the unit of length."""


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
def _view_cost(X, f, length, offset, correction, image_weight, length_weight, edges, n_near, hinges, stencils, weights):
    """Half the robust weighted sum of squares of one view.

    Args:
        X: (P, 3) points of the view.
        f: (P,) log conformal factors, or (0,) in isometric use.
        length: (E,) latent log lengths.
        offset: (E,) log ratio of arc to chord.
        correction: (P, 2) ray corrections.
        image_weight: (P,) inverse standard deviation of the image points.
        length_weight: (E,) inverse standard deviation of the log length residuals.
        edges, n_near, hinges: the mesh.
        stencils: (H, 4) hinge coefficients.
        weights: see `Weights`.
    """
    conformal = len(f) > 0
    total = 0.0
    for e in range(len(edges)):
        i, k = edges[e, 0], edges[e, 1]
        r = log_chord_kernel(X[i, 0], X[i, 1], X[i, 2], X[k, 0], X[k, 1], X[k, 2])[0] + offset[e] - length[e]
        if conformal:
            r -= 0.5 * (f[i] + f[k])
            if e < n_near:
                total += 0.5 * (weights.smoothness * (f[i] - f[k])) ** 2
        r = abs(r * length_weight[e])
        total += 0.5 * r * r if r <= weights.huber else weights.huber * (r - 0.5 * weights.huber)
    for i in range(len(X)):
        total += 0.5 * image_weight[i] ** 2 * (correction[i, 0] ** 2 + correction[i, 1] ** 2)
        if conformal:
            total += 0.5 * (weights.factor * f[i]) ** 2
    if weights.bending > 0.0:
        for h in range(len(hinges)):
            for a in range(3):
                r = 0.0
                for j in range(4):
                    r += stencils[h, j] * X[hinges[h, j], a]
                total += 0.5 * (weights.bending * r) ** 2
    return total


@njit(cache=True)
def _linearise_view(
    X, f, length, offset, correction, image_weight, length_weight, edges, n_near, hinges, stencils, weights, envelope,
    matrix, gradient, border, residual, inverse_variance,
):  # fmt: skip
    """Normal equations of one view; arguments before `envelope` as in `_view_cost`.

    Args:
        envelope: storage of the matrix (see `elimination`).
        matrix: output (N,), lower triangle.
        gradient: output (n,).
        border: output (E, 2 m): derivative of each length residual by the unknowns of its two ends.
        residual: output (E,) length residuals.
        inverse_variance: output (E,) their weights, robust loss included.
    """
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
        r = chord[0] + offset[e] - length[e]
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
    for i in range(len(X)):
        w = image_weight[i] ** 2
        for c in range(2):
            n = unknown[i] + 1 + c
            matrix[row[n] + n] += w
            gradient[n] += w * correction[i, c]
        if conformal:
            n = unknown[i] + 3
            matrix[row[n] + n] += weights.factor**2
            gradient[n] += weights.factor**2 * f[i]
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


@njit(cache=True, inline="always")
def _triangle_normals(X, triangles, normal):
    """Normals (P, 3) of the vertices: those of the triangles around them, weighted by area."""
    normal[:] = 0.0
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        a, b = X[j] - X[i], X[k] - X[i]
        cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
        for c in range(3):
            normal[i, c] += cross[c]
            normal[j, c] += cross[c]
            normal[k, c] += cross[c]
    for i in range(len(X)):
        size = np.sqrt(normal[i, 0] ** 2 + normal[i, 1] ** 2 + normal[i, 2] ** 2)
        if size > 0.0:
            normal[i] /= size
        else:
            normal[i] = X[i] / np.sqrt(X[i, 0] ** 2 + X[i, 1] ** 2 + X[i, 2] ** 2)


@njit(cache=True)
def _arc_offsets(X, triangles, edges, offset):
    """Log ratio of arc to chord of every edge of one view.

    Slopes come from a quadric about each vertex, fitted to its neighbours' heights over the plane of its triangles'
    mean normal; the mean normal alone is one-sided at the border.
    """
    P = len(X)
    normal, axis = np.empty((P, 3)), np.empty((P, 2, 3))
    _triangle_normals(X, triangles, normal)
    scale, count = np.zeros(P), np.zeros(P)
    for e in range(len(edges)):
        i, k = edges[e]
        square = (X[k, 0] - X[i, 0]) ** 2 + (X[k, 1] - X[i, 1]) ** 2 + (X[k, 2] - X[i, 2]) ** 2
        for p in (i, k):
            scale[p] += square
            count[p] += 1.0
    for i in range(P):
        n = normal[i]
        scale[i] = np.sqrt(scale[i] / max(count[i], 1.0))
        c = 0 if abs(n[0]) < 0.6 else 1
        t = -n[c] * n
        t[c] += 1.0
        t /= np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        axis[i, 0] = t
        axis[i, 1, 0] = n[1] * t[2] - n[2] * t[1]
        axis[i, 1, 1] = n[2] * t[0] - n[0] * t[2]
        axis[i, 1, 2] = n[0] * t[1] - n[1] * t[0]
    A, b, row = np.zeros((P, 5, 5)), np.zeros((P, 5)), np.empty(5)
    for e in range(len(edges)):
        for end in range(2):
            p, other = edges[e, end], edges[e, 1 - end]
            if not scale[p] > 0.0:
                continue
            x = y = h = 0.0
            for c in range(3):
                d = (X[other, c] - X[p, c]) / scale[p]
                x += d * axis[p, 0, c]
                y += d * axis[p, 1, c]
                h += d * normal[p, c]
            row[0], row[1], row[2], row[3], row[4] = x, y, x * x, x * y, y * y
            weight = 1.0 / max(x * x + y * y, 1e-4)
            for r in range(5):
                b[p, r] += weight * row[r] * h
                for c in range(5):
                    A[p, r, c] += weight * row[r] * row[c]
    for i in range(P):
        for r in range(5):
            A[i, r, r] += QUADRIC_RIDGE
        slope = np.linalg.solve(A[i], b[i])
        normal[i] -= slope[0] * axis[i, 0] + slope[1] * axis[i, 1]
        normal[i] /= np.sqrt(normal[i, 0] ** 2 + normal[i, 1] ** 2 + normal[i, 2] ** 2)
    for e in range(len(edges)):
        i, k = edges[e]
        dx, dy, dz = X[k, 0] - X[i, 0], X[k, 1] - X[i, 1], X[k, 2] - X[i, 2]
        size = np.sqrt(dx * dx + dy * dy + dz * dz)
        offset[e] = 0.0
        if size > 0.0:
            offset[e] = arc_offset(
                (normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / size,
                (normal[k, 0] * dx + normal[k, 1] * dy + normal[k, 2] * dz) / size,
            )


@njit(cache=True, nogil=True)
def arc_offset_kernel(first, last, X, triangles, edges, offset):
    """Log ratio of arc to chord of every edge into `offset` (F, E), for views first to last - 1."""
    for v in range(first, last):
        _arc_offsets(X[v], triangles, edges, offset[v])


@njit(cache=True, nogil=True)
def cost_kernel(
    first,
    last,
    X,
    f,
    length,
    offset,
    correction,
    image_weight,
    length_weight,
    edges,
    n_near,
    hinges,
    stencils,
    weights,
    cost,
):
    """Cost of views first to last - 1 into `cost` (F,); arguments as in `_view_cost`, with a dimension for views."""
    for v in range(first, last):
        cost[v] = _view_cost(
            X[v],
            f[v],
            length,
            offset[v],
            correction[v],
            image_weight[v],
            length_weight[v],
            edges,
            n_near,
            hinges,
            stencils,
            weights,
        )


@njit(cache=True, nogil=True)
def linearise_kernel(
    first, last, X, f, length, offset, correction, image_weight, length_weight, edges, n_near, hinges, stencils, weights, envelope,
    matrix, gradient, border, residual, inverse_variance,
):  # fmt: skip
    """Normal equations of views first to last - 1; arguments as in `_linearise_view`, with a dimension for views."""
    for v in range(first, last):
        _linearise_view(
            X[v], f[v], length, offset[v], correction[v], image_weight[v], length_weight[v], edges, n_near, hinges, stencils, weights,
            envelope, matrix[v], gradient[v], border[v], residual[v], inverse_variance[v],
        )  # fmt: skip
