"""Local shape of a view's mesh: its normals, and how it curves.

Normals and curvatures come from a quadric about each vertex.
"""

from __future__ import annotations

import numpy as np
from numba import njit

QUADRIC_RIDGE = 1e-2
"""Keeps the quadric about a vertex flat where it has too few neighbours to show its curvature."""


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


@njit(cache=True, inline="always")
def solved(A, b):
    """A^-1 b in the place of b, by Cholesky in the place of A, the lower triangle of a positive definite matrix."""
    n = len(b)
    for r in range(n):
        for c in range(r + 1):
            s = A[r, c]
            for k in range(c):
                s -= A[r, k] * A[c, k]
            A[r, c] = np.sqrt(s) if r == c else s / A[c, c]
    for r in range(n):
        for k in range(r):
            b[r] -= A[r, k] * b[k]
        b[r] /= A[r, r]
    for r in range(n - 1, -1, -1):
        for k in range(r + 1, n):
            b[r] -= A[k, r] * b[k]
        b[r] /= A[r, r]
    return b


@njit(cache=True)
def _quadrics(X, triangles, edges, normal, axis, curvature):
    """A quadric about each vertex, fitted to its neighbours' heights over the plane of its triangles' mean normal.

    The mean normal alone is one-sided at the border. All outputs but the first belong to the plane of the mean normal.

    Args:
        X: (P, 3) points of one view.
        triangles, edges: the mesh.
        normal: output (P, 3) unit normals of the quadrics.
        axis: output (P, 2, 3) unit vectors in the plane.
        curvature: output (P, 3) second derivatives xx, xy, yy of the height along these.
    """
    P = len(X)
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
                for c in range(r + 1):
                    A[p, r, c] += weight * row[r] * row[c]
    for i in range(P):
        for r in range(5):
            A[i, r, r] += QUADRIC_RIDGE
        slope = solved(A[i], b[i])
        normal[i] -= slope[0] * axis[i, 0] + slope[1] * axis[i, 1]
        normal[i] /= np.sqrt(normal[i, 0] ** 2 + normal[i, 1] ** 2 + normal[i, 2] ** 2)
        size = max(scale[i], 1e-300)
        curvature[i, 0] = 2.0 * slope[2] / size
        curvature[i, 1] = slope[3] / size
        curvature[i, 2] = 2.0 * slope[4] / size


@njit(cache=True)
def quadric_normals(X, triangles, edges, normal):
    """Unit normals (P, 3) of one view by the quadrics about its vertices."""
    P = len(X)
    _quadrics(X, triangles, edges, normal, np.empty((P, 2, 3)), np.empty((P, 3)))


@njit(cache=True, nogil=True)
def shear_kernel(first, last, X, triangles, edges, shear):
    """Trace-free normal curvature times length at both ends of every edge into `shear` (F, E, 2).

    Moebius maps leave it as it is, reflections of space turn its sign: the trace-free second fundamental form is a
    conformal invariant of weight one.
    """
    P = X.shape[1]
    normal, axis, curvature = np.empty((P, 3)), np.empty((P, 2, 3)), np.empty((P, 3))
    for v in range(first, last):
        _quadrics(X[v], triangles, edges, normal, axis, curvature)
        for e in range(len(edges)):
            for end in range(2):
                p, other = edges[e, end], edges[e, 1 - end]
                x = y = 0.0
                for c in range(3):
                    x += (X[v, other, c] - X[v, p, c]) * axis[p, 0, c]
                    y += (X[v, other, c] - X[v, p, c]) * axis[p, 1, c]
                xx, xy, yy = curvature[p]
                size = max(np.sqrt(x * x + y * y), 1e-300)
                shear[v, e, end] = (0.5 * (xx - yy) * (x * x - y * y) + 2.0 * xy * x * y) / size
