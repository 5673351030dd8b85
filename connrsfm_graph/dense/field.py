"""Images of normals from sparse normals, by B-splines: the network's input in training and in use."""

from __future__ import annotations

from functools import cache

import numpy as np

from connrsfm_graph.dense.spline_depth import axis_matrix
from connrsfm_graph.dense.window import grid
from connrsfm_graph.surface_spline import bending_matrix
from connrsfm_graph.warps.basis import SplineGrid

CONTROL_POINTS = 11
"""Control points per axis over the window."""
BENDING = 3e-5
"""Bending weight. It is one number for all inputs, so that the network can learn what it leaves of the noise."""
_MARGIN = 0.05

_GRID = SplineGrid(CONTROL_POINTS, np.full(2, -1.0 - _MARGIN), np.full(2, 2.0 * (1.0 + _MARGIN) / (CONTROL_POINTS - 3)))


def normal_images(p: np.ndarray, m: np.ndarray, weight: np.ndarray, size: int) -> np.ndarray:
    """Images (B, size, size, 3) of unit normals; rows along the second window coordinate, columns along the first.

    Args:
        p: (B, N, 2) window coordinates of the sparse points.
        m: (B, N, 3) unit normals of the log-depth surface there, see `dense.window`.
        weight: (B, N), 0 for points that do not exist.
        size: pixels per side.
    """
    B, N, _ = p.shape
    along, down = (axis_matrix(_GRID, axis, p[..., axis].ravel()) for axis in range(2))
    design = (along[:, :, None] * down[:, None, :]).reshape(B, N, -1)
    weighted = (design * weight[..., None]).swapaxes(1, 2)
    n_points = np.maximum(weight.sum(axis=1), 1.0)
    normal = weighted @ design / n_points[:, None, None] + _regularisation()
    control = np.linalg.solve(normal, weighted @ m / n_points[:, None, None])
    control = control.reshape(B, CONTROL_POINTS, CONTROL_POINTS, 3)
    places = grid(size)
    rows, columns = axis_matrix(_GRID, 1, places), axis_matrix(_GRID, 0, places)
    images = np.einsum("yj,xi,bijc->byxc", rows, columns, control, optimize=True)
    return images / np.maximum(np.linalg.norm(images, axis=-1, keepdims=True), np.finfo(float).tiny)


@cache
def _regularisation() -> np.ndarray:
    """(n^2, n^2) bending energy, and a ridge that holds control points which no normal reaches."""
    return BENDING * bending_matrix(_GRID) + 1e-9 * np.eye(CONTROL_POINTS**2)
