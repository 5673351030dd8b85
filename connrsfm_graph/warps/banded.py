"""Symmetric band matrices of the spline's normal equations: assembly, and the inverse inside the band.

A matrix of size N with `b` sub-diagonals is stored as (N, b + 1): entry [j, i - j] is A[i, j] for i >= j. Its transpose
is LAPACK's lower band storage, so `scipy.linalg.cholesky_banded(band.T, lower=True)` factorises it without a copy.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def add_data(
    band: np.ndarray,
    right: np.ndarray,
    first: np.ndarray,
    value: np.ndarray,
    weight: np.ndarray,
    target: np.ndarray,
    n: int,
) -> None:
    """Add sum_p weight_p |value_p c - target_p|^2 to normal equations `band` c = `right`, both components.

    Args:
        band, right: (N, b + 1) and (N,), changed in place; N = 2 n^2.
        first, value: (P,) and (P, 16) first control point and weights of each row.
        weight: (P,).
        target: (P, 2).
        n: control points per axis.
    """
    for p in range(len(first)):
        for k in range(16):
            column = first[p] + (k // 4) * n + k % 4
            scaled = weight[p] * value[p, k]
            for c in range(2):
                right[2 * column + c] += scaled * target[p, c]
            for m in range(k, 16):
                offset = first[p] + (m // 4) * n + m % 4 - column
                for c in range(2):
                    band[2 * column + c, 2 * offset] += scaled * value[p, m]


@njit(cache=True)
def times(band: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(N,) product of a symmetric band matrix (N, b + 1) and a vector."""
    N, width = band.shape
    out = band[:, 0] * x
    for j in range(N):
        for m in range(1, min(width, N - j)):
            out[j + m] += band[j, m] * x[j]
            out[j] += band[j, m] * x[j + m]
    return out


@njit(cache=True)
def inverse_in_band(lower: np.ndarray) -> np.ndarray:
    """Entries of A^-1 inside the band of A, from its Cholesky factor (Takahashi's recursion).

    From A^-1 L = L^-T, column j of the inverse follows from the columns right of it. The work is N b^2, that of the
    factorisation, where the full inverse would take N^2 b.

    Args:
        lower: (N, b + 1) factor L in band storage.

    Returns:
        (N, b + 1) band of the inverse.
    """
    N, width = lower.shape
    inverse = np.zeros_like(lower)
    column = np.empty(width)
    for j in range(N - 1, -1, -1):
        last = min(width, N - j)
        for m in range(1, last):
            column[m] = lower[j, m] / lower[j, 0]
        for i in range(1, last):
            total = 0.0
            for m in range(1, i):
                total += column[m] * inverse[j + m, i - m]
            for m in range(i, last):
                total += column[m] * inverse[j + i, m - i]
            inverse[j, i] = -total
        total = 1.0 / lower[j, 0] ** 2
        for m in range(1, last):
            total -= column[m] * inverse[j, m]
        inverse[j, 0] = total
    return inverse


@njit(cache=True)
def patch_blocks(band: np.ndarray, first: np.ndarray, n: int) -> np.ndarray:
    """(P, 32, 32) blocks of a symmetric band matrix that belong to the 16 control points (both components) of each row.

    Args:
        band: (N, b + 1).
        first: (P,) first control point of each row.
        n: control points per axis.
    """
    blocks = np.empty((len(first), 32, 32))
    local = np.empty(32, np.int64)
    for k in range(32):
        local[k] = 2 * ((k // 8) * n + (k // 2) % 4) + k % 2
    for p in range(len(first)):
        for k in range(32):
            for m in range(k + 1):
                entry = band[2 * first[p] + local[m], local[k] - local[m]]
                blocks[p, k, m] = entry
                blocks[p, m, k] = entry
    return blocks
