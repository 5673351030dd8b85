"""Polynomials in two unknowns x and y, and the global minimum of one.

A polynomial is an array of coefficients (..., d + 1, d + 1) with entry [i, j] the factor of x^i y^j; leading dimensions
are independent polynomials.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eig

_REAL = 1e-3
"""Largest imaginary part, relative to the modulus, of an eigenvalue taken for real; polishing mends the rest."""
_NEWTON_STEPS = 5


def value(p: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(N,) values of one polynomial at points (N, 2), or its value at one point (2,)."""
    powers = np.asarray(point)[..., None] ** np.arange(len(p))
    return np.einsum("...i,ij,...j->...", powers[..., 0, :], p, powers[..., 1, :])


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Product of polynomials of degrees d and e, of degree d + e; leading dimensions broadcast."""
    n, m = p.shape[-1], q.shape[-1]
    result = np.zeros((*np.broadcast_shapes(p.shape[:-2], q.shape[:-2]), n + m - 1, n + m - 1))
    for i in range(n):
        for j in range(n):
            result[..., i : i + m, j : j + m] += p[..., i, j, None, None] * q
    return result


def affine(constant: np.ndarray, by_x: float, by_y: float) -> np.ndarray:
    """constant + by_x x + by_y y for an array of constants."""
    result = np.zeros((*np.shape(constant), 2, 2))
    result[..., 0, 0], result[..., 1, 0], result[..., 0, 1] = constant, by_x, by_y
    return result


def global_minimum(p: np.ndarray) -> np.ndarray:
    """(2,) place of the least value of one polynomial (d + 1, d + 1) that is bounded below, of total degree d.

    All stationary points are found at once: with y as a parameter the resultant of the two derivatives vanishes, which
    is an eigenvalue problem in y with x in the eigenvectors (Sylvester matrix). The best one is polished by Newton.
    """
    dx, dy = _derivative(p, 0), _derivative(p, 1)
    candidates = _common_zeros(dx, dy)
    best = candidates[np.argmin(value(p, candidates))]
    dxx, dxy, dyy = _derivative(dx, 0), _derivative(dx, 1), _derivative(dy, 1)
    for _ in range(_NEWTON_STEPS):
        gradient = np.array([value(dx, best), value(dy, best)])
        xx, xy, yy = (value(second, best) for second in (dxx, dxy, dyy))
        trial = best - np.linalg.lstsq(np.array([[xx, xy], [xy, yy]]), gradient)[0]
        if not value(p, trial) < value(p, best):
            break
        best = trial
    return best


def _derivative(p: np.ndarray, axis: int) -> np.ndarray:
    """Derivative by x (axis 0) or y (axis 1) as a polynomial of one degree less."""
    factor = np.arange(1, len(p))
    return p[1:, :-1] * factor[:, None] if axis == 0 else p[:-1, 1:] * factor


def _common_zeros(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 2) real common zeros of two polynomials of degree d, always with the origin among them."""
    d = len(a) - 1
    sylvester = np.zeros((d + 1, 2 * d, 2 * d))
    for j in range(d + 1):
        for row in range(d):
            sylvester[j, row, row : row + d + 1] = a[::-1, j]
            sylvester[j, d + row, row : row + d + 1] = b[::-1, j]
    # sum_j y^j S_j v = 0 with v = (x^(2d-1), ..., x, 1), as a generalised eigenvalue problem of d times the size.
    size = 2 * d
    left, right = np.eye(d * size, k=size), np.eye(d * size)
    left[-size:] = -sylvester[:d].transpose(1, 0, 2).reshape(size, d * size)
    right[-size:, -size:] = sylvester[d]
    with np.errstate(divide="ignore", invalid="ignore"):
        y, vectors = eig(left, right)
        x = vectors[size - 2] / vectors[size - 1]
        real = np.isfinite(y) & np.isfinite(x) & (np.abs(y.imag) <= _REAL * (1.0 + np.abs(y)))
    return np.concatenate([np.stack([x[real].real, y[real].real], axis=-1), np.zeros((1, 2))])
