"""Marginal covariances of first-order terms from the subgraphs of all points, in compiled code.

What `gtsam_backend.marginal_covariances` reads from GTSAM one point at a time: the blocks of the inverse of a point's
normal equations. Only blocks in the pattern of the Cholesky factor are formed, from the last image eliminated to the
first (Takahashi's recursion), so that the work is that of a factorisation.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from connrsfm_graph.problem import Problem, State
from connrsfm_graph.solvers.batched import active_columns, row_precisions
from connrsfm_graph.solvers.block_cholesky import analyse
from connrsfm_graph.solvers.interface import Minimum, PairModel
from connrsfm_graph.solvers.one_point import linearise_point, pair_scratch, point_equations, solve_point
from factors.noise import PairNoise


def first_order_covariances(
    problem: Problem,
    state: State,
    active: tuple[str, ...],
    noise: PairNoise,
    model: PairModel = PairModel.CONFORMAL,
    prior: float = 0.0,
) -> np.ndarray:
    """(P, F, 2, 2) marginal covariance of the first-order terms of every point, NaN where it has none.

    Args:
        problem, state: the measurements, and the minimum at which they are linearised.
        active, noise, model: as in `Backend.minimise`; "d" must be active.
        prior: information of a prior on every active variable, in the unit of `noise`; where it is 0, points whose
            pairs do not determine all variables have NaN.
    """
    columns, scaled = active_columns(active, model)
    covariance = _marginals(
        int(model),
        state.frame,
        state.log_scale,
        problem.data,
        problem.weight,
        problem.edges,
        analyse(problem.n_frames, problem.edges),
        columns,
        scaled,
        problem.camera.kappa,
        row_precisions(problem, noise, model),
        noise.huber,
        prior,
    )
    covariance[~problem.constrained()] = np.nan
    return np.asarray(covariance)


def certainty(problem: Problem, minimum: Minimum, active: tuple[str, ...], noise: PairNoise) -> np.ndarray:
    """(P, F) reciprocal variance of the first-order terms of every point, in units of the median; 0 where it has none.

    A point's marginal variance is multiplied by what its rows leave per degree of freedom, half its own and half that
    of a typical point: a point in a wrong minimum is sharply determined, too, but contradicts its rows. Slopes and
    curvatures are of order one, which is their prior, since a point with few pairs may not determine all of them.
    """
    covariance = first_order_covariances(problem, minimum.state, active, noise, prior=1.0)
    known = np.isfinite(covariance).all(axis=(-2, -1))
    rows = int((noise.precisions() > 0).sum()) - ("s" in active)
    columns = 2 * ("d" in active) + 3 * ("c" in active)
    freedom = rows * (problem.weight > 0).sum(axis=1) - columns * known.sum(axis=1)
    misfit = minimum.cost / np.maximum(freedom, 1)
    misfit += max(float(np.median(misfit[known.any(axis=1)])), np.finfo(float).tiny)
    reciprocal = np.zeros(known.shape)
    reciprocal[known] = 1.0 / (np.trace(covariance, axis1=2, axis2=3) * misfit[:, None])[known]
    return reciprocal / np.median(reciprocal[known])


@njit(cache=True, parallel=True)
def _marginals(
    model, frame, log_scale, data, weight, edges, structure, columns, scaled, kappa, precision, huber, prior
):
    P, F, _ = frame.shape
    n = len(columns)
    covariance = np.full((P, F, 2, 2), np.nan)
    for i in prange(P):
        H = point_equations(F, len(edges), len(structure.row), n)
        linearise_point(
            model,
            frame[i],
            log_scale[i],
            data[i],
            weight[i],
            edges,
            structure,
            columns,
            scaled,
            kappa,
            precision[i],
            huber,
            pair_scratch(),
            H,
        )
        diagonal, lower = np.empty_like(H[0]), np.empty_like(H[1])
        step, scale_step = np.empty((F, n)), np.empty(len(edges))
        if solve_point(weight[i], edges, structure, scaled, prior, H, diagonal, lower, step, scale_step):
            invert_factor(structure, diagonal, lower)
            covariance[i] = diagonal[:, :2, :2]
    return covariance


@njit(cache=True)
def invert_factor(structure, diagonal, lower):
    """Blocks of the inverse of H from its Cholesky factor L, in place.

    With U_m = L_mj D_j^-1 for the blocks m below the diagonal D_j of column j,

        Z_mj = -sum_k Z_mk U_k,    Z_jj = (D_j D_j^T)^-1 - sum_k U_k^T Z_kj.

    Args:
        structure, diagonal, lower: as `block_cholesky.factor_and_solve` leaves them; overwritten.
    """
    order, column, row, target = structure.order, structure.column, structure.row, structure.target
    n = diagonal.shape[1]
    inverse = np.empty((n, n))
    t = len(target)
    for j in range(len(order) - 1, -1, -1):
        first = column[j]
        size = column[j + 1] - first
        t -= size * (size - 1) // 2
        D = diagonal[order[j]]
        for c in range(n):
            for r in range(n):
                s = 1.0 if r == c else 0.0
                for k in range(c, r):
                    s -= D[r, k] * inverse[k, c]
                inverse[r, c] = s / D[r, r] if r >= c else 0.0
        U, Z = np.zeros((size, n, n)), np.zeros((size, n, n))
        for m in range(size):
            _add_product(U[m], lower[first + m], inverse, False, 1.0)
        pair = t
        for m in range(size):
            _add_product(Z[m], diagonal[order[row[first + m]]], U[m], False, -1.0)
            for m2 in range(m):
                between = lower[target[pair]]
                pair += 1
                _add_product(Z[m], between, U[m2], False, -1.0)
                _add_product(Z[m2], between, U[m], True, -1.0)
        D[:] = 0.0
        _add_product(D, inverse, inverse, True, 1.0)
        for m in range(size):
            _add_product(D, U[m], Z[m], True, -1.0)
            lower[first + m] = Z[m]


@njit(cache=True)
def _add_product(out, left, right, transposed, sign):
    """out += sign left right, or sign left^T right."""
    n = len(out)
    for i in range(n):
        for k in range(n):
            factor = sign * (left[k, i] if transposed else left[i, k])
            for j in range(n):
                out[i, j] += factor * right[k, j]
