"""Patches registered to how they looked when first seen, so that small errors from image to image do not add up.

Around a point the surface's warp is an affinity A. The patch of the first view, sampled on a grid d, is aligned with
the new image at x + A d by inverse-compositional Gauss-Newton over x and A (Baker and Matthews, "Lucas-Kanade 20 years
on", IJCV 2004); brightness and contrast are eliminated by projecting them out of residual and derivatives.
"""

from __future__ import annotations

import numpy as np

_ITERATIONS = 10
_CONVERGED = 0.01
"""Pixels."""
_DAMPING = 1e-3
"""Share of its own size added to the normal matrix; keeps patches that show one edge only from sliding along it."""


def patches(grey: np.ndarray, at: np.ndarray, side: int) -> np.ndarray:
    """(N, side, side) float32, the patches around points (N, 2) of an image, which is continued at its border."""
    return _sampled(grey, at[:, None] + _grid(side)).reshape(-1, side, side)


def register(
    patch: np.ndarray, grey: np.ndarray, at: np.ndarray, affinity: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Align patches with an image.

    Args:
        patch: (N, side, side) float32 as first seen.
        grey: (H, W) uint8, the new image.
        at: (N, 2) roughly where they are now, within a pixel or two.
        affinity: (N, 2, 2) roughly how they are distorted.

    Returns:
        Place (N, 2), affinity (N, 2, 2), and the correlation (N,) of the aligned patches, at most 1.
    """
    side = patch.shape[1]
    d = _grid(side)
    at, affinity = at.astype(np.float64), affinity.copy()
    by_row, by_column = np.gradient(patch, axis=(1, 2))
    gradient = np.stack([by_column, by_row], axis=-1).reshape(len(patch), side * side, 2)
    J = np.concatenate(
        [gradient, (gradient[..., :, None] * d[None, :, None, :]).reshape(*gradient.shape[:2], 4)], axis=2
    )
    first, size = _standardised(patch.reshape(len(patch), side * side))
    J = J / np.maximum(size, 1e-6)[:, None, None]
    J -= J.mean(axis=1, keepdims=True)
    J -= first[..., None] * (first[:, None] @ J)
    transposed = np.ascontiguousarray(J.transpose(0, 2, 1))
    normal = transposed @ J
    diagonal = np.einsum("nii->ni", normal)
    diagonal += _DAMPING * diagonal + 1e-12

    moving = np.arange(len(patch))
    for _ in range(_ITERATIONS):
        now, _ = _standardised(_sampled(grey, at[moving, None] + d @ affinity[moving].transpose(0, 2, 1)))
        step = np.linalg.solve(normal[moving], transposed[moving] @ now[..., None])[..., 0]
        shift, stretch = step[:, :2], np.eye(2) + step[:, 2:].reshape(-1, 2, 2).clip(-0.3, 0.3)
        affinity[moving] = affinity[moving] @ np.linalg.inv(stretch)
        change = np.einsum("nij,nj->ni", affinity[moving], shift)
        at[moving] -= change
        moving = moving[np.linalg.norm(change, axis=1) > _CONVERGED]
        if not len(moving):
            break
    now, _ = _standardised(_sampled(grey, at[:, None] + d @ affinity.transpose(0, 2, 1)))
    return at, affinity, np.einsum("nk,nk->n", now, first)


def _grid(side: int) -> np.ndarray:
    """(side^2, 2) offsets (x, y) of a patch's pixels from its centre."""
    axis = np.arange(side) - (side - 1) / 2
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2).astype(np.float32)


def _sampled(grey: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(N, K) float32 values of an image at places (N, K, 2) by linear interpolation (OpenCV's rounds to 1/32)."""
    height, width = grey.shape
    x, y = np.clip(places[..., 0], 0, width - 1.001), np.clip(places[..., 1], 0, height - 1.001)
    column, row = x.astype(np.int32), y.astype(np.int32)
    x, y = (x - column).astype(np.float32), (y - row).astype(np.float32)
    corner = row * width + column
    flat = grey.ravel().astype(np.float32)
    above = (1 - x) * flat[corner] + x * flat[corner + 1]
    below = (1 - x) * flat[corner + width] + x * flat[corner + width + 1]
    return np.asarray((1 - y) * above + y * below)


def _standardised(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N, K) with mean 0 and norm 1, and the norms (N,) they had."""
    values = values - values.mean(axis=1, keepdims=True)
    size = np.linalg.norm(values, axis=1)
    return values / np.maximum(size, 1e-6)[:, None], size
