"""Where a known surface must have moved, as a rigid body, to be seen as in an image: a start for its deformation."""

from __future__ import annotations

import numpy as np
from numba import njit

from connrsfm_graph.refine.curvature import solved
from connrsfm_graph.threads import over_views

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
    over_views(_move_kernel, len(points), points, image, seen, moved)
    return moved


@njit(cache=True, nogil=True)
def _move_kernel(first, last, points, image, seen, moved):
    """Move surfaces first to last - 1, which `moved` holds unmoved."""
    for v in range(first, last):
        X = moved[v]
        for _ in range(_ITERATIONS):
            _take_step(X, image[v], seen[v])
            if not X[:, 2].min() > 0.0:
                break
        if not (X[:, 2].min() > 0.0 and _error(X, image[v], seen[v]) < _error(points[v], image[v], seen[v])):
            X[:] = points[v]


@njit(cache=True, nogil=True)
def _take_step(X, image, seen):
    """Turn X (P, 3) about its centre and shift it: a Gauss-Newton step."""
    P = len(X)
    centre = np.zeros(3)
    for i in range(P):
        centre += X[i]
    centre /= P
    N, g, J = np.zeros((6, 6)), np.zeros(6), np.empty(6)
    for i in range(P):
        if not seen[i]:
            continue
        a, b, c = X[i] - centre
        z = X[i, 2]
        for axis in range(2):
            # Derivatives by the point, then by the rotation vector: X + rotation x (X - centre) + shift.
            J[3], J[4], J[5] = 0.0, 0.0, -X[i, axis] / z**2
            J[3 + axis] = 1.0 / z
            J[0], J[1], J[2] = b * J[5] - c * J[4], c * J[3] - a * J[5], a * J[4] - b * J[3]
            residual = X[i, axis] / z - image[i, axis]
            for r in range(6):
                g[r] -= J[r] * residual
                for s in range(6):
                    N[r, s] += J[r] * J[s]
    for r in range(6):
        N[r, r] += _DAMPING * N[r, r] + 1e-300
    step = solved(N, g)
    R = _rotation(step[:3])
    for i in range(P):
        a, b, c = X[i] - centre
        for r in range(3):
            X[i, r] = centre[r] + R[r, 0] * a + R[r, 1] * b + R[r, 2] * c + step[3 + r]


@njit(cache=True, nogil=True)
def _error(X, image, seen):
    """Sum of squares of the projections' residuals."""
    total = 0.0
    for i in range(len(X)):
        if seen[i]:
            total += (X[i, 0] / X[i, 2] - image[i, 0]) ** 2 + (X[i, 1] / X[i, 2] - image[i, 1]) ** 2
    return total


@njit(cache=True, nogil=True)
def _rotation(vector):
    """(3, 3) rotation by a vector (3,): Rodrigues' formula."""
    a, b, c = vector
    angle = max(np.sqrt(a * a + b * b + c * c), 1e-12)
    K = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    return np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * (K @ K)
