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
    linear, motion = _fitted(before, after, before, near[:, 1:])
    return linear, np.linalg.norm(after - before - motion, axis=1)


def affinity_at(
    before: np.ndarray, after: np.ndarray, at: np.ndarray, neighbours: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where the affinities of their surroundings put other points, by the same robust fit.

    Args:
        before, after: (N, 2) pixels of the same points in two images, N from 4.
        at: (M, 2) pixels of other points in the first image.
        neighbours: how many nearest points to use.

    Returns:
        Places (M, 2) in the second image, and linear parts (M, 2, 2).
    """
    _, near = cKDTree(before).query(at, min(neighbours, len(before)))
    linear, motion = _fitted(before, after, at, near)
    return at + motion, linear


def _fitted(before: np.ndarray, after: np.ndarray, at: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear parts (M, 2, 2) of the affinities of points `near` (M, k) places `at` (M, 2), and the motions (M, 2)."""
    n, k = near.shape
    offset = (before[near] - at[:, None]).astype(np.float64)
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
    return np.eye(2) + (affinity[:, :2] / scale).transpose(0, 2, 1), affinity[:, 2]
