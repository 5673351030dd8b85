"""Symmetric positive definite matrices of many views, all sparse in the same envelope: factors and substitutions.

Row r is stored from its first non-zero column on; points are ordered by a sweep across the surface, so rows are short.
Cholesky factors stay inside the envelope, and the cost is linear in views.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from connrsfm_graph.refine.sums import sums_of_products

_TILE = 3
"""Rows that are factored at a time."""


class Envelope(NamedTuple):
    """Which entries of a view's matrix are stored. A named tuple, since compiled code takes it as it is."""

    first: np.ndarray
    """(n,) first stored column of each row."""
    start: np.ndarray
    """(n + 1,) where each row begins in the array of values; row r ends with its diagonal."""
    unknown: np.ndarray
    """(P,) first unknown of each point."""


def make_envelope(order: np.ndarray, cliques: list[np.ndarray], size: int) -> Envelope:
    """Envelope for points in a given order.

    Args:
        order: (P,) position of each point.
        cliques: arrays (N, c) of points that share a term of the cost.
        size: unknowns per point.
    """
    first_point = np.arange(len(order))
    for points in cliques:
        position = order[points]
        np.minimum.at(first_point, position, np.broadcast_to(position.min(axis=1, keepdims=True), position.shape))
    first = np.repeat(size * first_point, size)
    # Rows are factored in tiles: those of a tile begin at the same column, where a tile of columns begins.
    tile = np.arange(len(first)) // _TILE
    lowest = np.full(tile[-1] + 1, len(first))
    np.minimum.at(lowest, tile, first // _TILE * _TILE)
    first = lowest[tile]
    start = np.concatenate([[0], np.cumsum(np.arange(len(first)) - first + 1)])
    return Envelope(first, start, size * order)


@njit(cache=True)
def _dot(a, b):
    return sums_of_products((a,), (b,), len(a))[0]


@njit(cache=True)
def _factor_view(A, first, start):
    """Cholesky factor in place; false where A is not positive definite. Rows left over by tiles go one by one."""
    inverse = np.empty(len(first))  # of the diagonal: divisions would take as long as the sums
    whole = len(first) // _TILE * _TILE
    for R in range(0, whole, _TILE):
        if not _factor_tile(A, first, start, R, inverse):
            return False
    for r in range(whole, len(first)):
        row = A[start[r] : start[r + 1]]
        low = first[r]
        for c in range(low, r):
            begin = max(low, first[c])
            other = A[start[c] + begin - first[c] : start[c + 1]]
            size = c - begin
            row[c - low] = (row[c - low] - _dot(row[begin - low : c - low], other[:size])) / other[size]
        left = row[: r - low]
        s = row[r - low] - _dot(left, left)
        if not s > 0.0:
            return False
        row[r - low] = np.sqrt(s)
    return True


@njit(cache=True)
def _factor_tile(A, first, start, R, inverse):
    """Rows R to R + 2 of the factor: three rows and three columns at a time read every number once for three products.

    With L_C the 3 x 3 diagonal block of a tile of columns and s the products of what lies left of it, the block below
    is (A - s) L_C^-T.
    """
    low = first[R]
    x0, x1, x2 = A[start[R] : start[R + 1]], A[start[R + 1] : start[R + 2]], A[start[R + 2] : start[R + 3]]
    for C in range(low, R, _TILE):
        begin = max(low, first[C])
        size, skip = C - begin, begin - first[C]
        a0, a1, a2 = x0[begin - low :], x1[begin - low :], x2[begin - low :]
        b0 = A[start[C] + skip : start[C + 1]]
        b1 = A[start[C + 1] + skip : start[C + 2]]
        b2 = A[start[C + 2] + skip : start[C + 3]]
        s00, s01, s02, s10, s11, s12, s20, s21, s22 = sums_of_products((a0, a1, a2), (b0, b1, b2), size)
        of_tile = inverse[C : C + 3]
        _below(a0, size, s00, s01, s02, b1, b2, of_tile)
        _below(a1, size, s10, s11, s12, b1, b2, of_tile)
        _below(a2, size, s20, s21, s22, b1, b2, of_tile)
    m = R - low
    s00, _, _, s10, s11, _, s20, s21, s22 = sums_of_products((x0, x1, x2), (x0, x1, x2), m)
    pivot = x0[m] - s00
    if not pivot > 0.0:
        return False
    x0[m] = np.sqrt(pivot)
    inverse[R] = 1.0 / x0[m]
    x1[m] = (x1[m] - s10) * inverse[R]
    pivot = x1[m + 1] - s11 - x1[m] ** 2
    if not pivot > 0.0:
        return False
    x1[m + 1] = np.sqrt(pivot)
    inverse[R + 1] = 1.0 / x1[m + 1]
    x2[m] = (x2[m] - s20) * inverse[R]
    x2[m + 1] = (x2[m + 1] - s21 - x2[m] * x1[m]) * inverse[R + 1]
    pivot = x2[m + 2] - s22 - x2[m] ** 2 - x2[m + 1] ** 2
    if not pivot > 0.0:
        return False
    x2[m + 2] = np.sqrt(pivot)
    inverse[R + 2] = 1.0 / x2[m + 2]
    return True


@njit(cache=True)
def _below(row, at, s0, s1, s2, b1, b2, inverse):
    """Three entries of a row from `at` on: (row - s) L^-T, L the lower triangle of the rows b from `at` on.

    `inverse` (3,) holds one over the diagonal of L.
    """
    x0 = (row[at] - s0) * inverse[0]
    x1 = (row[at + 1] - s1 - x0 * b1[at]) * inverse[1]
    row[at], row[at + 1] = x0, x1
    row[at + 2] = (row[at + 2] - s2 - x0 * b2[at] - x1 * b2[at + 1]) * inverse[2]


@njit(cache=True)
def factor_damped(A, damping, first, start):
    """Multiply the diagonal of one view's matrix by 1 + damping and factor in place; false where that fails."""
    for r in range(len(first)):
        A[start[r + 1] - 1] *= 1.0 + damping
    return _factor_view(A, first, start)


@njit(cache=True, nogil=True)
def factor_kernel(begin, end, matrix, damping, first, start, fine):
    """`factor_damped` of views begin to end - 1; `fine` (F,) says whether that succeeded."""
    for f in range(begin, end):
        fine[f] = factor_damped(matrix[f], damping, first, start)


@njit(cache=True)
def substitute(L, first, start, x):
    """Solve L L' y = x in place, for one view."""
    n = len(first)
    for r in range(n):
        left = L[start[r] : start[r + 1] - 1]
        x[r] = (x[r] - _dot(left, x[first[r] : r])) / L[start[r + 1] - 1]
    for r in range(n - 1, -1, -1):
        left, above = L[start[r] : start[r + 1] - 1], x[first[r] : r]
        s = x[r] / L[start[r + 1] - 1]
        x[r] = s
        for k in range(len(left)):
            above[k] -= left[k] * s


@njit(cache=True, nogil=True)
def solve_kernel(begin, end, factor, first, start, x):
    """x_sf = H_f^-1 x_sf in place for views begin to end - 1 and all right-hand sides, x (S, F, n)."""
    for f in range(begin, end):
        for s in range(len(x)):
            substitute(factor[f], first, start, x[s, f])
