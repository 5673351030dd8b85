"""Block elimination of the refinement's normal equations: views first, what borders them last.

    [ H_1            W_1 ] [x_1]     [g_1]
    [      ...       ... ] [...] = - [...]         H_f sparse, W_f two points per column
    [           H_F  W_F ] [x_F]     [g_F]
    [ W_1' ...  W_F'  D  ] [ l ]     [ h ]          l shared lengths and, of stretched views, their strains

Each view's H_f is factored by Cholesky inside its envelope: row r is stored from its first non-zero column on, and
points are ordered by a sweep across the surface, so rows are short. The cost is linear in views. The Schur complement
S = D - sum_f W_f' H_f^-1 W_f on the border is dense, so it is never formed: conjugate gradients apply it by one
forward and backward substitution per view. Several right-hand sides at once read each view's factor once for all.

A length that all views share may change by as much as their noise allows: that of the lengths, and that of the image
points at both ends, by which every view moves its points to fit. So with D_f = w_f a view's part of D, J_f its
residuals' derivatives by the ray corrections and A the weights of these, summed over the views,

    S^-1 ~ D^-1 + (1 / F) sum_f J_f A^-1 J_f'

but for what depths give way, little where views differ, and less where lengths have a prior of their own. Without its
second part the conjugate gradients would take the longer, the more tightly lengths are held. What depths do one
solution finds out for the next (see `memory`). Strains of different views meet in the lengths only: their parts of S
are inverted.

A length residual falls by the sum of its shared length and its view's strain times a derivative; all of S acts through
these sums, one for every residual.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numba import njit

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.refine.envelope import Envelope, factor_kernel, solve_kernel, substitute
from connrsfm_graph.refine.memory import KEPT, Memory
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
    by_strain: np.ndarray
    """(F, E, K) derivative of what each length residual falls by, by the K numbers of its view's strain; K may be 0."""
    weight: np.ndarray
    """(F, E) weight of each length residual; W_f = -(weight border)' on the sums of lengths and strains."""
    length_gradient: np.ndarray
    """(E,) h."""
    unit: float
    """Inverse standard deviation of the mean log length."""
    length_weight: np.ndarray
    """(E,) weight of every log length's own prior."""
    strain_gradient: np.ndarray
    """(F, K)."""
    strain_weight: float
    """Weight of the strains' own prior."""
    ray_weight: np.ndarray
    """(P,) weight of the ray corrections' own prior, summed over the views; not zero."""

    @property
    def border_gradient(self) -> np.ndarray:
        """(E + F K,) h."""
        return np.concatenate([self.length_gradient, self.strain_gradient.ravel()])


@njit(cache=True, inline="always")
def spread_view(border, weight, ends, v, x):
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
    """x_sf += W_f v_sf for views begin to end - 1."""
    for f in range(begin, end):
        for s in range(len(x)):
            spread_view(border[f], weight[f], ends, v[s, f], x[s, f])


@njit(cache=True, nogil=True)
def _gather_all(begin, end, border, weight, ends, x, out):
    """out_sf = W_f' x_sf for views begin to end - 1."""
    for f in range(begin, end):
        for s in range(len(x)):
            _gather(border[f], weight[f], ends, x[s, f], out[s, f])


@njit(cache=True, nogil=True)
def _schur_terms(begin, end, factor, first, start, border, weight, ends, v, out):
    """out_sf = (D_f - W_f' H_f^-1 W_f) v_sf for views begin to end - 1, but for the priors."""
    for f in range(begin, end):
        for s in range(len(v)):
            x = np.zeros(len(first))
            spread_view(border[f], weight[f], ends, v[s, f], x)
            substitute(factor[f], first, start, x)
            _gather(border[f], weight[f], ends, x, out[s, f])
            for e in range(len(ends)):
                out[s, f, e] = weight[f, e] * v[s, f, e] - out[s, f, e]


@njit(cache=True, nogil=True)
def _ray_terms(begin, end, border, ends, give, v, out):
    """out_sf = J_f diag(give) J_f' v_s for views begin to end - 1, with J_f the derivatives by the views' unknowns.

    `give` (n,) is zero but for ray corrections; v (S, E).
    """
    one = np.ones(len(ends))
    for f in range(begin, end):
        for s in range(len(v)):
            x = np.zeros(len(give))
            spread_view(border[f], one, ends, v[s], x)
            x *= give
            _gather(border[f], one, ends, x, out[s, f])


class Factorised:
    """Damped normal equations with the views' matrices factored; solves and products with inverses."""

    def __init__(
        self,
        equations: NormalEquations,
        envelope: Envelope,
        edges: np.ndarray,
        damping: float = 0.0,
        memory: Memory | None = None,
    ):
        """Factor.

        Args:
            equations: the normal equations; the factors take the place of their matrix.
            envelope: storage of the views' matrices.
            edges: (E, 2) points of each length.
            damping: Marquardt's: diagonals are multiplied by 1 + damping.
            memory: of former equations that were much the same; solutions add to it.

        Raises:
            ComputationError: a view's matrix is not positive definite.
        """
        self.equations = equations
        self.envelope = envelope
        self.ends = envelope.unknown[edges]
        self.memory = Memory() if memory is None else memory
        of_strains = np.einsum("fe,fek->fk", equations.weight, equations.by_strain**2) + equations.strain_weight
        of_lengths = equations.weight.sum(axis=0) + equations.length_weight
        self.diagonal = np.concatenate([of_lengths, of_strains.ravel()]) * (1.0 + damping)
        priors = equations.length_weight, np.full(of_strains.size, equations.strain_weight)
        self.prior = np.concatenate(priors) + self.diagonal * (damping / (1.0 + damping))
        self.give = self._given_by_rays(damping)
        self.free = self._free_of_prior()
        self.factor = equations.matrix
        fine = np.empty(len(self.factor), dtype=bool)
        over_views(factor_kernel, len(fine), self.factor, damping, envelope.first, envelope.start, fine)
        if not fine.all():
            raise ComputationError("refinement: the normal equations of a view are not positive definite")
        self.of_strains = self._of_strains()

    def solve_views(self, x: np.ndarray) -> np.ndarray:
        """H_f^-1 x_f for all views, shape (S, F, n)."""
        x = x.copy()
        over_views(solve_kernel, x.shape[1], self.factor, self.envelope.first, self.envelope.start, x)
        return x

    def spread(self, v: np.ndarray) -> np.ndarray:
        """W_f v_f for all views, shape (S, F, n), from (S, F, E) or from (S, 1, E), the same for all views."""
        (F, n), E = self.equations.gradient.shape, v.shape[-1]
        x, v = np.zeros((len(v), F, n)), np.broadcast_to(v, (len(v), F, E))
        over_views(_spread_all, F, self.equations.border, self.equations.weight, self.ends, v, x)
        return x

    def gather(self, x: np.ndarray) -> np.ndarray:
        """sum_f W_f' x_f, shape (S, E + F K), from (S, F, n)."""
        F, E = self.equations.weight.shape
        out = np.empty((len(x), F, E))
        over_views(_gather_all, F, self.equations.border, self.equations.weight, self.ends, x, out)
        return self.border_part(out)

    def of_residuals(self, v: np.ndarray) -> np.ndarray:
        """What every length residual falls by, (S, F, E) or (S, 1, E), for lengths and strains (S, E + F K)."""
        F, E, K = self.equations.by_strain.shape
        if not K:
            return v[:, None]
        strain = v[:, E:].reshape(-1, F, K)
        return v[:, None, :E] + np.einsum("fek,sfk->sfe", self.equations.by_strain, strain)

    def border_part(self, values: np.ndarray) -> np.ndarray:
        """The transpose: (S, E + F K) from values at length residuals (S, F, E)."""
        by_strain = np.einsum("fek,sfe->sfk", self.equations.by_strain, values)
        return np.concatenate([values.sum(axis=1), by_strain.reshape(len(values), -1)], axis=1)

    def schur_product(self, v: np.ndarray) -> np.ndarray:
        """S v, shape (S, E + F K)."""
        e = self.equations
        F, E = e.weight.shape
        out = np.empty((len(v), F, E))
        sums = np.ascontiguousarray(np.broadcast_to(self.of_residuals(v), out.shape))
        over_views(_schur_terms, F, self.factor, *self.envelope[:2], e.border, e.weight, self.ends, sums, out)
        product = self.border_part(out) + self.prior * v
        product[:, :E] += e.unit**2 * v[:, :E].mean(axis=1, keepdims=True) / E
        return product

    def _given_by_rays(self, damping: float) -> np.ndarray:
        """(n,) inverse weights of the ray corrections, summed over the views; zero for other unknowns. Before the
        views' matrices are factored."""
        rays = self.envelope.unknown[:, None] + np.array([1, 2])
        diagonal = self.equations.matrix[:, self.envelope.start[rays + 1] - 1].sum(axis=0)
        give = np.zeros(len(self.envelope.first))
        give[rays] = 1.0 / (self.equations.ray_weight[:, None] + damping * diagonal)
        return give

    def _free_of_prior(self) -> np.ndarray:
        """(E,) square roots of the parts of what rays allow lengths to change that the lengths' own prior leaves."""
        E, m = len(self.ends), self.equations.border.shape[2] // 2
        give = self.give[self.ends[:, :, None] + np.arange(m)].reshape(E, 2 * m)
        variance = 1.0 / self.diagonal[:E] + ((self.equations.border**2).mean(axis=0) * give).sum(axis=1)
        return np.asarray(1.0 / np.sqrt(1.0 + self.prior[:E] * variance))

    def _of_strains(self) -> np.ndarray:
        """(F, K, K) inverses of the parts of S that belong to the strain of one view."""
        F, E, K = self.equations.by_strain.shape
        if not K:
            return np.zeros((F, 0, 0))
        each = np.zeros((K, E + F * K))
        for k in range(K):
            each[k, E + k :: K] = 1.0
        parts = self.schur_product(each)[:, E:].reshape(K, F, K)
        return np.linalg.inv(np.moveaxis(parts, 0, -1))

    def roughly_solved(self, rhs: np.ndarray) -> np.ndarray:
        """S^-1 rhs, roughly, shape (S, E + F K): what depths and conformal factors give way to lengths is left out."""
        F, E = self.equations.weight.shape
        by_rays = np.empty((len(rhs), F, E))
        over_views(_ray_terms, F, self.equations.border, self.ends, self.give, self.free * rhs[:, :E], by_rays)
        lengths = rhs[:, :E] / self.diagonal[:E] + self.free * by_rays.mean(axis=1)
        strain = np.einsum("fkl,sfl->sfk", self.of_strains, rhs[:, E:].reshape(len(rhs), F, self.of_strains.shape[-1]))
        return np.concatenate([lengths, strain.reshape(len(rhs), rhs.shape[1] - E)], axis=1)

    def solve_border(self, rhs: np.ndarray, tolerance: float, limit: int = 500) -> np.ndarray:
        """S^-1 rhs, shape (S, E + F K), by preconditioned conjugate gradients.

        Each right-hand side on its own, to `limit` products or a relative `tolerance`, in the norm of the
        preconditioner: about that of the cost.
        """
        v, residual = np.zeros_like(rhs), rhs.copy()
        direction = self.memory.precondition(residual, self.roughly_solved)
        size = (residual * direction).sum(axis=1)
        goal = tolerance**2 * size
        directions: deque[np.ndarray] = deque(maxlen=KEPT)
        products: deque[np.ndarray] = deque(maxlen=KEPT)
        for _ in range(limit):
            active = np.flatnonzero(size > goal)
            if len(active) == 0:
                break
            along = direction[active]
            product = self.schur_product(along)
            curvature = (along * product).sum(axis=1)
            goal[active[~(curvature > 0.0)]] = np.inf  # rounding is all that is left
            directions.extend(along[curvature > 0.0])
            products.extend(product[curvature > 0.0])
            part = np.divide(size[active], curvature, out=np.zeros_like(curvature), where=curvature > 0.0)[:, None]
            v[active] += part * along
            residual[active] -= part * product
            z = self.memory.precondition(residual[active], self.roughly_solved)
            last, size[active] = size[active], (residual[active] * z).sum(axis=1)
            direction[active] = z + (size[active] / last)[:, None] * along
        self.memory.keep(directions, products)
        return v

    def step(self, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton step: (F, n) of the views' unknowns and (E + F K,) of the lengths and strains."""
        views, border = self.solve(self.equations.gradient[None], self.equations.border_gradient[None], tolerance)
        return views[0], border[0]

    def correction(self, residual: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Step against length residuals (F, E) that a step has left beyond what its linearisation says."""
        gradient = self.border_part(-(self.equations.weight * residual)[None])
        views, border = self.solve(-self.spread(residual[None]), gradient, tolerance)
        return views[0], border[0]

    def solve(
        self, gradient: np.ndarray, border_gradient: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Minus the inverse of the whole matrix times (S, F, n) and (S, E + F K)."""
        inner = self.solve_views(gradient)
        border = self.solve_border(self.gather(inner) - border_gradient, tolerance)
        return -inner - self.solve_views(self.spread(self.of_residuals(border))), border
