"""Where a known surface must have moved, as a rigid body, to be seen as in an image: a start for its deformation."""

from __future__ import annotations

import numpy as np

_ITERATIONS = 8
_DAMPING = 1e-3
"""Of every Gauss-Newton step, relative to the diagonal."""


def moved_rigidly(points: np.ndarray, image: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Surfaces (B, P, 3) moved so that they project, in the least-squares sense, to the image points.

    Gauss-Newton on the six parameters of each motion, from no motion. Surfaces that this would bring behind the camera
    or farther off their image points stay where they are.

    Args:
        points: (B, P, 3) finite, in front of the camera.
        image: (B, P, 2) normalised coordinates, any finite value where not seen.
        seen: (B, P) bool.
    """
    moved = points.copy()
    for _ in range(_ITERATIONS):
        residual, J = _linearised(moved, image, seen)
        N = np.einsum("bpki,bpkj->bij", J, J)
        N += (_DAMPING * np.einsum("bii->bi", N) + 1e-300)[:, None] * np.eye(6)
        step = -np.linalg.solve(N, np.einsum("bpki,bpk->bi", J, residual)[..., None])[..., 0]
        centre = moved.mean(axis=1, keepdims=True)
        moved = centre + np.einsum("bij,bpj->bpi", _rotation(step[:, :3]), moved - centre) + step[:, None, 3:]
        moved[(moved[..., 2] <= 0).any(axis=1)] = np.nan
    better = np.nan_to_num(_error(moved, image, seen), nan=np.inf) < _error(points, image, seen)
    return np.where(better[:, None, None], moved, points)


def _linearised(points: np.ndarray, image: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (B, P, 2) of the projections and their derivatives (B, P, 2, 6) by rotation vector and translation."""
    x, y, z = np.moveaxis(np.nan_to_num(points, nan=1.0), -1, 0)
    zero = np.zeros_like(x)
    by_point = np.stack([np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], axis=-2)
    a, b, c = np.moveaxis(np.nan_to_num(points - points.mean(axis=1, keepdims=True)), -1, 0)
    turn = np.stack([np.stack([zero, c, -b], -1), np.stack([-c, zero, a], -1), np.stack([b, -a, zero], -1)], axis=-2)
    J = np.concatenate([by_point @ turn, by_point], axis=-1)
    residual = np.stack([x / z, y / z], axis=-1) - image
    return np.where(seen[..., None], residual, 0.0), np.where(seen[..., None, None], J, 0.0)


def _error(points: np.ndarray, image: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(B,) sum of squares of the projections' residuals."""
    return np.where(seen[..., None], (points[..., :2] / points[..., 2:] - image) ** 2, 0.0).sum(axis=(1, 2))


def _rotation(vector: np.ndarray) -> np.ndarray:
    """(B, 3, 3) rotations by vectors (B, 3): Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    a, b, c = vector.T
    zero = np.zeros_like(a)
    K = np.stack([np.stack([zero, -c, b], -1), np.stack([c, zero, -a], -1), np.stack([-b, a, zero], -1)], axis=-2)
    small = np.maximum(angle, 1e-12)
    return np.eye(3) + np.sin(small) / small * K + (1.0 - np.cos(small)) / small**2 * (K @ K)
