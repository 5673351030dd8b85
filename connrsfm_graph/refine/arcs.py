"""Ratios of arc to chord: how much longer the surface's curve over an edge is than the edge.

They come from the angles at which the surface rises from the chord at both ends. Where depths are exact a quadric about
each vertex tells them. Noise of the depths looks like curvature to it: surfaces that crumple then have arcs as long as
ever, and nothing that compares arcs stops them. Noisy surfaces are therefore smoothed before arcs are measured over
them; the arcs of what is smoothed away are missed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from connrsfm_graph.refine.curvature import quadric_normals
from connrsfm_graph.surface_spline import SurfaceSpline
from connrsfm_graph.threads import mapped
from connrsfm_graph.warps.basis import VALUE, U, V
from factors.edge_length import arc_offset
from factors.surface import PERSPECTIVE

_BENDING = 1e-5
"""Bending weight for every point of a view. With it what is left of a wave of log depth of a third of the image's
extent is a half, of longer ones nearly all."""
_CONTROL_POINTS = 14
"""Of a spline per axis, at most."""


class ArcSplines(NamedTuple):
    """Smoothing splines of log depth over the images, ready for any depths. A named tuple, since compiled code takes it
    as it is."""

    columns: np.ndarray
    """(F, P, 16) control points that a point depends on; (F, 0, 16) where nothing is smoothed."""
    rows: np.ndarray
    """(F, P, 3, 16) value and derivatives by the image coordinates of a point from these."""
    smoothing: np.ndarray
    """(F, M, M) control points from the sums of rows of values times log depths."""

    @staticmethod
    def over(image: np.ndarray) -> ArcSplines:
        """Splines over image points (F, P, 2), normalised coordinates."""
        F, P, _ = image.shape
        one = np.ones((P, 1))

        def of_view(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            spline = SurfaceSpline(image[view], (VALUE,), one, one[:, 0], image[view], _CONTROL_POINTS, PERSPECTIVE)
            first, rows = spline.grid.rows(image[view])
            lower, _ = spline.normal_equations()
            lower += _BENDING * P * spline.bending
            normal = np.tril(lower) + np.tril(lower, -1).T
            return first[:, None] + spline.grid.patch(), rows[:, (VALUE, U, V)], np.linalg.inv(normal)

        return ArcSplines(*(np.stack(parts) for parts in zip(*mapped(of_view, range(F)), strict=True)))

    @staticmethod
    def none(n_views: int) -> ArcSplines:
        """Nothing is smoothed."""
        return ArcSplines(
            np.zeros((n_views, 0, 16), dtype=np.int64), np.zeros((n_views, 0, 3, 16)), np.zeros((n_views, 0, 0))
        )

    def views(self, index: np.ndarray) -> ArcSplines:
        """The splines of some views."""
        return ArcSplines(*(part[index] for part in self))

    def replaced(self, index: np.ndarray, other: ArcSplines) -> ArcSplines:
        """The splines with those of some views taken from splines of only these."""
        parts = [part.copy() for part in self]
        for part, new in zip(parts, other, strict=True):
            part[index] = new
        return ArcSplines(*parts)


@njit(cache=True)
def _smooth(X, columns, rows, smoothing, Y, normal):
    """Points Y (P, 3) and unit normals (P, 3) of the smoothed surface of one view; other arguments as in `ArcSplines`,
    of this view."""
    P, M = len(X), len(smoothing)
    right, control = np.zeros(M), np.zeros(M)
    for p in range(P):
        b = np.log(X[p, 2])
        for k in range(16):
            right[columns[p, k]] += rows[p, 0, k] * b
    for m in range(M):
        control += smoothing[m] * right[m]
    for p in range(P):
        b = b_u = b_v = 0.0
        for k in range(16):
            c = control[columns[p, k]]
            b += rows[p, 0, k] * c
            b_u += rows[p, 1, k] * c
            b_v += rows[p, 2, k] * c
        u, v, z = X[p, 0] / X[p, 2], X[p, 1] / X[p, 2], np.exp(b)
        Y[p, 0], Y[p, 1], Y[p, 2] = z * u, z * v, z
        c = 1.0 + u * b_u + v * b_v
        size = np.sqrt(b_u * b_u + b_v * b_v + c * c)
        normal[p, 0], normal[p, 1], normal[p, 2] = b_u / size, b_v / size, -c / size


@njit(cache=True)
def arc_offsets(X, edges, triangles, columns, rows, smoothing, offset):
    """Log ratio of arc to chord of every edge of one view, X (P, 3), into `offset` (E,); splines as in `ArcSplines`."""
    normal, Y = np.empty(X.shape), X
    if len(columns):
        Y = np.empty(X.shape)
        _smooth(X, columns, rows, smoothing, Y, normal)
    else:
        quadric_normals(X, triangles, edges, normal)
    for e in range(len(edges)):
        i, k = edges[e]
        dx, dy, dz = Y[k, 0] - Y[i, 0], Y[k, 1] - Y[i, 1], Y[k, 2] - Y[i, 2]
        size = np.sqrt(dx * dx + dy * dy + dz * dz)
        offset[e] = 0.0
        if size > 0.0:
            rise_i = (normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / size
            rise_k = (normal[k, 0] * dx + normal[k, 1] * dy + normal[k, 2] * dz) / size
            offset[e] = arc_offset(np.arcsin(min(max(rise_i, -1.0), 1.0)), np.arcsin(min(max(rise_k, -1.0), 1.0)))


@njit(cache=True, nogil=True)
def arc_offset_kernel(first, last, X, triangles, edges, splines, offset):
    """Log ratio of arc to chord of every edge into `offset` (F, E), for views first to last - 1."""
    columns, rows, smoothing = splines
    for v in range(first, last):
        arc_offsets(X[v], edges, triangles, columns[v], rows[v], smoothing[v], offset[v])
