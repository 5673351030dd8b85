"""Block elimination of the refinement's normal equations: views first, shared lengths last.

    [ H_1            W_1 ] [x_1]     [g_1]
    [      ...       ... ] [...] = - [...]         H_f sparse, W_f two points per column
    [           H_F  W_F ] [x_F]     [g_F]
    [ W_1' ...  W_F'  D  ] [ l ]     [ h ]          D diagonal, plus the mean length's prior of rank one

Each view's H_f is factored by Cholesky inside its envelope: row r is stored from its first non-zero column on, and
points are ordered by a sweep across the surface, so rows are short. The cost is linear in views. The Schur complement
S = D - sum_f W_f' H_f^-1 W_f on the lengths is dense, so it is never formed: conjugate gradients apply it by one
forward and backward substitution per view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.threads import over_views

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


@dataclass(frozen=True)
class NormalEquations:
    """Linearised cost of F views with n unknowns each and E shared lengths."""

    matrix: np.ndarray
    """(F, N) lower triangles H_f inside the envelope."""
    gradient: np.ndarray
    """(F, n) gradients g_f."""
    border: np.ndarray
    """(F, E, 2 m) derivative of each length residual by the m unknowns of its two points."""
    weight: np.ndarray
    """(F, E) weight of each length residual; W_f = -(weight border)'."""
    length_gradient: np.ndarray
    """(E,) h."""
    unit: float
    """Inverse standard deviation of the mean log length."""


# Kernels run along slices from zero, so that the compiler sees no negative index and uses vector instructions.
@njit(cache=True, inline="always")
def _dot(a, b):
    s = 0.0
    for k in range(len(a)):
        s += a[k] * b[k]
    return s


@njit(cache=True, inline="always")
def _factor_view(A, first, start):
    """Cholesky factor in place; false where A is not positive definite. Rows left over by tiles go one by one."""
    whole = len(first) // _TILE * _TILE
    for R in range(0, whole, _TILE):
        if not _factor_tile(A, first, start, R):
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


@njit(cache=True, inline="always")
def _factor_tile(A, first, start, R):
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
        s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
        for k in range(size):
            s00 += a0[k] * b0[k]
            s01 += a0[k] * b1[k]
            s02 += a0[k] * b2[k]
            s10 += a1[k] * b0[k]
            s11 += a1[k] * b1[k]
            s12 += a1[k] * b2[k]
            s20 += a2[k] * b0[k]
            s21 += a2[k] * b1[k]
            s22 += a2[k] * b2[k]
        _below(a0, size, s00, s01, s02, b0, b1, b2)
        _below(a1, size, s10, s11, s12, b0, b1, b2)
        _below(a2, size, s20, s21, s22, b0, b1, b2)
    m = R - low
    s00 = s10 = s11 = s20 = s21 = s22 = 0.0
    for k in range(m):
        s00 += x0[k] * x0[k]
        s10 += x1[k] * x0[k]
        s11 += x1[k] * x1[k]
        s20 += x2[k] * x0[k]
        s21 += x2[k] * x1[k]
        s22 += x2[k] * x2[k]
    pivot = x0[m] - s00
    if not pivot > 0.0:
        return False
    x0[m] = np.sqrt(pivot)
    x1[m] = (x1[m] - s10) / x0[m]
    pivot = x1[m + 1] - s11 - x1[m] ** 2
    if not pivot > 0.0:
        return False
    x1[m + 1] = np.sqrt(pivot)
    x2[m] = (x2[m] - s20) / x0[m]
    x2[m + 1] = (x2[m + 1] - s21 - x2[m] * x1[m]) / x1[m + 1]
    pivot = x2[m + 2] - s22 - x2[m] ** 2 - x2[m + 1] ** 2
    if not pivot > 0.0:
        return False
    x2[m + 2] = np.sqrt(pivot)
    return True


@njit(cache=True, inline="always")
def _below(row, at, s0, s1, s2, b0, b1, b2):
    """Three entries of a row from `at` on: (row - s) L^-T, L the lower triangle of the rows b from `at` on."""
    row[at] = (row[at] - s0) / b0[at]
    row[at + 1] = (row[at + 1] - s1 - row[at] * b1[at]) / b1[at + 1]
    row[at + 2] = (row[at + 2] - s2 - row[at] * b2[at] - row[at + 1] * b2[at + 1]) / b2[at + 2]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _factor(begin, end, matrix, damping, first, start, fine):
    """Damp the diagonals and factor views begin to end - 1 in place; `fine` (F,) says whether that succeeded."""
    for f in range(begin, end):
        for r in range(len(first)):
            matrix[f, start[r + 1] - 1] *= 1.0 + damping[f]
        fine[f] = _factor_view(matrix[f], first, start)


@njit(cache=True, inline="always")
def _substitute(L, first, start, x):
    """Solve L L' y = x in place."""
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


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _solve_views(begin, end, factor, first, start, x):
    """x_f = H_f^-1 x_f in place for views begin to end - 1."""
    for f in range(begin, end):
        _substitute(factor[f], first, start, x[f])


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _solve_many(begin, end, factor, first, start, x):
    """The same for several right-hand sides at once, x (F, n, R)."""
    n, R = x.shape[1:]
    for f in range(begin, end):
        L, y = factor[f], x[f]
        for r in range(n):
            row = y[r]
            for c in range(first[r], r):
                value, other = L[start[r] + c - first[r]], y[c]
                for k in range(R):
                    row[k] -= value * other[k]
            for k in range(R):
                row[k] /= L[start[r + 1] - 1]
        for r in range(n - 1, -1, -1):
            row = y[r]
            for k in range(R):
                row[k] /= L[start[r + 1] - 1]
            for c in range(first[r], r):
                value, other = L[start[r] + c - first[r]], y[c]
                for k in range(R):
                    other[k] -= value * row[k]


@njit(cache=True, inline="always")
def _spread(border, weight, ends, v, x):
    """x += W v for one view, from lengths to unknowns."""
    m = border.shape[1] // 2
    for e in range(len(v)):
        s = -weight[e] * v[e]
        for c in range(m):
            x[ends[e, 0] + c] += s * border[e, c]
            x[ends[e, 1] + c] += s * border[e, m + c]


@njit(cache=True, inline="always")
def _gather(border, weight, ends, x, v):
    """v = W' x for one view, from unknowns to lengths."""
    m = border.shape[1] // 2
    for e in range(len(v)):
        s = 0.0
        for c in range(m):
            s += border[e, c] * x[ends[e, 0] + c] + border[e, m + c] * x[ends[e, 1] + c]
        v[e] = -weight[e] * s


@njit(cache=True, nogil=True)
def _spread_all(begin, end, border, weight, ends, v, x):
    """x_f += W_f v_f for views begin to end - 1."""
    for f in range(begin, end):
        _spread(border[f], weight[f], ends, v[f], x[f])


@njit(cache=True, nogil=True)
def _gather_all(begin, end, border, weight, ends, x, out):
    """out_f = W_f' x_f for views begin to end - 1."""
    for f in range(begin, end):
        _gather(border[f], weight[f], ends, x[f], out[f])


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _schur_terms(begin, end, factor, first, start, border, weight, ends, v, out):
    """out_f = W_f' H_f^-1 W_f v for views begin to end - 1."""
    for f in range(begin, end):
        x = np.zeros(len(first))
        _spread(border[f], weight[f], ends, v, x)
        _substitute(factor[f], first, start, x)
        _gather(border[f], weight[f], ends, x, out[f])


class Factorised:
    """Damped normal equations with the views' matrices factored; solves and products with inverses."""

    def __init__(
        self, equations: NormalEquations, envelope: Envelope, edges: np.ndarray, damping: float | np.ndarray = 0.0
    ):
        """Factor.

        Args:
            equations: the normal equations.
            envelope: storage of the views' matrices.
            edges: (E, 2) points of each length.
            damping: Marquardt's: diagonals are multiplied by 1 + damping; one number, or (F,) one for each view (the
                lengths then take the largest).

        Raises:
            ComputationError: a view's matrix is not positive definite.
        """
        self.equations = equations
        self.envelope = envelope
        self.ends = envelope.unknown[edges]
        damping = np.broadcast_to(np.asarray(damping, dtype=float), (len(equations.matrix),))
        self.diagonal = equations.weight.sum(axis=0) * (1.0 + damping.max())
        self.factor = equations.matrix.copy()
        fine = np.empty(len(self.factor), dtype=bool)
        over_views(_factor, len(fine), self.factor, damping, envelope.first, envelope.start, fine)
        if not fine.all():
            raise ComputationError("refinement: the normal equations of a view are not positive definite")

    def solve_views(self, x: np.ndarray) -> np.ndarray:
        """H_f^-1 x_f for all views, shape (F, n), or (F, n, R) for several right-hand sides."""
        x = x.copy()
        kernel = _solve_views if x.ndim == 2 else _solve_many
        over_views(kernel, len(x), self.factor, self.envelope.first, self.envelope.start, x)
        return x

    def spread(self, v: np.ndarray) -> np.ndarray:
        """W_f v_f for all views, shape (F, n), from (F, E) or from (E,), the same for all."""
        x = np.zeros_like(self.equations.gradient)
        v = np.broadcast_to(v, self.equations.weight.shape)
        over_views(_spread_all, len(x), self.equations.border, self.equations.weight, self.ends, v, x)
        return x

    def gather(self, x: np.ndarray) -> np.ndarray:
        """sum_f W_f' x_f, shape (E,), from (F, n)."""
        out = np.empty_like(self.equations.weight)
        over_views(_gather_all, len(x), self.equations.border, self.equations.weight, self.ends, x, out)
        return out.sum(axis=0)

    def schur_product(self, v: np.ndarray) -> np.ndarray:
        """S v."""
        e = self.equations
        out = np.empty_like(e.weight)
        over_views(_schur_terms, len(out), self.factor, *self.envelope[:2], e.border, e.weight, self.ends, v, out)
        return self.diagonal * v + e.unit**2 * v.mean() / len(v) - out.sum(axis=0)

    def solve_lengths(self, rhs: np.ndarray, tolerance: float, limit: int = 500) -> np.ndarray:
        """S^-1 rhs by conjugate gradients preconditioned with D, to a relative `tolerance` or `limit` products."""
        v, residual = np.zeros_like(rhs), rhs.copy()
        z = residual / self.diagonal
        direction = z.copy()
        size = goal = float(residual @ z)
        goal *= tolerance**2
        for _ in range(limit):
            if not size > goal:
                break
            product = self.schur_product(direction)
            curvature = float(direction @ product)
            if not curvature > 0.0:
                break
            v += size / curvature * direction
            residual -= size / curvature * product
            z = residual / self.diagonal
            size, last = float(residual @ z), size
            direction = z + size / last * direction
        return v

    def step(self, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton step: (F, n) of the views' unknowns and (E,) of the lengths."""
        return self.solve(self.equations.gradient, self.equations.length_gradient, tolerance)

    def solve(
        self, gradient: np.ndarray, length_gradient: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Minus the inverse of the whole matrix times (F, n) and (E,)."""
        inner = self.solve_views(gradient)
        lengths = self.solve_lengths(self.gather(inner) - length_gradient, tolerance)
        return -inner - self.solve_views(self.spread(lengths)), lengths
