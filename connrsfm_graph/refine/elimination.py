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

import numpy as np
from numba import njit

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.refine.envelope import Envelope, factor_kernel, solve_kernel, substitute
from connrsfm_graph.threads import over_views


@dataclass(frozen=True)
class NormalEquations:
    """Linearised cost of F views with n unknowns each and E shared lengths."""

    matrix: np.ndarray
    """(F, N) lower triangles H_f inside the envelope; overwritten by their factors (see `Factorised`)."""
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
    length_weight: np.ndarray
    """(E,) weight of every log length's own prior."""


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


@njit(cache=True, nogil=True)
def _schur_terms(begin, end, factor, first, start, border, weight, ends, v, out):
    """out_f = W_f' H_f^-1 W_f v for views begin to end - 1."""
    for f in range(begin, end):
        x = np.zeros(len(first))
        _spread(border[f], weight[f], ends, v, x)
        substitute(factor[f], first, start, x)
        _gather(border[f], weight[f], ends, x, out[f])


class Factorised:
    """Damped normal equations with the views' matrices factored; solves and products with inverses."""

    def __init__(self, equations: NormalEquations, envelope: Envelope, edges: np.ndarray, damping: float = 0.0):
        """Factor.

        Args:
            equations: the normal equations; the factors take the place of their matrix.
            envelope: storage of the views' matrices.
            edges: (E, 2) points of each length.
            damping: Marquardt's: diagonals are multiplied by 1 + damping.

        Raises:
            ComputationError: a view's matrix is not positive definite.
        """
        self.equations = equations
        self.envelope = envelope
        self.ends = envelope.unknown[edges]
        self.diagonal = (equations.weight.sum(axis=0) + equations.length_weight) * (1.0 + damping)
        self.factor = equations.matrix
        fine = np.empty(len(self.factor), dtype=bool)
        over_views(factor_kernel, len(fine), self.factor, damping, envelope.first, envelope.start, fine)
        if not fine.all():
            raise ComputationError("refinement: the normal equations of a view are not positive definite")

    def solve_views(self, x: np.ndarray) -> np.ndarray:
        """H_f^-1 x_f for all views, shape (F, n)."""
        x = x.copy()
        over_views(solve_kernel, len(x), self.factor, self.envelope.first, self.envelope.start, x)
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
