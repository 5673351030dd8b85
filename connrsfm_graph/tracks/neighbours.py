"""How a point's surroundings move: the affinity of its nearest neighbours."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_ITERATIONS = 4
_RIDGE = 1e-6
"""Keeps the affinity of neighbours on one line at no distortion across it."""
_PRECISION = 0.05
"""Pixels; residuals are not told apart below this."""


def local_affinity(before: np.ndarray, after: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """The affinities by which the surroundings of points move, and how well the points themselves follow.

    Fitted without the point itself by iteratively reweighted least squares (Cauchy weights scaled by the median
    residual), so one wrong neighbour does not condemn its surroundings. Fewer than four points say nothing: they get
    the identity and no error.

    Args:
        before, after: (N, 2) pixels of the same points in two images.
        neighbours: how many nearest points to use.

    Returns:
        Linear parts (N, 2, 2), and distances (N,) in pixels from where the affinity puts each point.
    """
    n = len(before)
    if n < 4:
        return np.tile(np.eye(2), (n, 1, 1)), np.zeros(n)
    k = min(neighbours, n - 1)
    _, near = cKDTree(before).query(before, k + 1)
    near = near[:, 1:]
    offset = (before[near] - before[:, None]).astype(np.float64)
    scale = np.sqrt((offset**2).mean(axis=(1, 2), keepdims=True)) + 1e-9
    design = np.concatenate([offset / scale, np.ones((n, k, 1))], axis=2)
    motion = (after - before)[near].astype(np.float64)
    weight = np.ones((n, k))
    for _ in range(_ITERATIONS):
        weighted = design * weight[..., None]
        normal = np.einsum("nki,nkj->nij", weighted, design) + _RIDGE * k * np.eye(3)
        affinity = np.linalg.solve(normal, np.einsum("nki,nkj->nij", weighted, motion))
        residual = np.linalg.norm(motion - design @ affinity, axis=2)
        typical = 2 * np.median(residual, axis=1, keepdims=True) + _PRECISION
        weight = 1 / (1 + (residual / typical) ** 2)
    linear = np.eye(2) + (affinity[:, :2] / scale).transpose(0, 2, 1)
    return linear, np.linalg.norm(after - before - affinity[:, 2], axis=1)
