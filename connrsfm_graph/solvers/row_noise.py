"""How far the 21 rows of each pair can be trusted, from the warps' uncertainty and the misfit of the data themselves.

A row differs from zero at the true surface for two reasons: the warp's jet is wrong, and Theorem 1 holds only where
rotation and scale vary slowly. The first is known per point and edge up to a factor, J C J^T with the jet's posterior
covariance C (`factors.jet_noise`): it is large at the border of the tracks and where they are sparse. The second is
about the same everywhere. So a row of block b has

    sigma^2 = s_b^2 ((1 - q_b) + q_b v / v_b),

with v its variance by the jet, v_b the median of that over the pairs, s_b the sigma of a typical pair and q_b the share
of the jets in it. s_b and q_b are those of highest likelihood given the rows at the pre-step's surfaces: there points
are held by their neighbours and not by the pairs alone, so that what the rows leave is not fitted away. Rows have heavy
tails, hence Student's distribution. Sigmas are held fixed in the solve, whose cost stays a sum of squares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from connrsfm_graph.initialise import with_pair_scale
from connrsfm_graph.integrate import integrate
from connrsfm_graph.problem import Problem, State
from factors.conformal_pair import residuals
from factors.jet_noise import row_variances
from factors.noise import BLOCKS, ROWS, PairNoise

_FREEDOM = 3.0
"""Degrees of freedom of Student's distribution."""
_SHARES = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95])
"""Shares of the jets that are tried; never all, since no warp is exact."""
_ROUNDS = 30
"""Fixed-point iterations for the scale of Student's distribution, which settles to a percent in ten."""
_LEAST = 1e-6
"""Smallest sigma of a block: rows of exact planes leave nothing but rounding."""


@dataclass(frozen=True)
class RowNoise:
    """Noise of the rows of all pairs."""

    precision: np.ndarray
    """(P, E, 21) reciprocal sigmas over those of the `PairNoise` they were estimated for (`Problem.precision`)."""
    sigma: Mapping[str, float]
    """Sigma of a typical pair, by block."""
    share: Mapping[str, float]
    """Share of the jets in its square, by block."""


def estimate_row_noise(problem: Problem, covariance: np.ndarray | None, start: State, noise: PairNoise) -> RowNoise:
    """Sigmas of all rows.

    Args:
        problem: the measurements.
        covariance: (E, P, 10, 10) of the jets; None where it is not known.
        start: the pre-step's outcome.
        noise: blocks that are dropped here stay dropped; its other sigmas have no effect.
    """
    surface = integrate(problem, start)
    state = start.updated(first_order=surface.first_order, second_order=surface.second_order)
    state = with_pair_scale(problem, state, PairNoise(extrinsic=np.inf))  # scales by the metric, as at the start
    point, edge = np.nonzero(problem.weight > 0)
    ends = [state.frame[point, problem.edges[edge, end]] for end in (0, 1)]
    log_rho = state.log_scale[point, edge] + problem.camera.kappa * (ends[1][:, 5] - ends[0][:, 5])
    rows = problem.data[point, edge], ends[0][:, :5], ends[1][:, :5], log_rho
    square = residuals(*rows, problem.camera) ** 2
    by_jet = np.zeros_like(square)
    if covariance is not None:
        by_jet = row_variances(*rows, covariance[edge, point], problem.camera)
    precision = np.ones((*problem.weight.shape, ROWS))
    sigma, share = {}, {}
    for name, block in BLOCKS.items():
        if np.isinf(getattr(noise, name)):
            continue
        typical = by_jet[:, block].mean(axis=1)
        relative = by_jet[:, block] / max(float(np.median(typical)), np.finfo(float).tiny)
        sigma[name], share[name] = _likeliest(square[:, block].mean(axis=1), relative.mean(axis=1))
        variance = (1.0 - share[name]) + share[name] * relative
        precision[point[:, None], edge[:, None], block] = getattr(noise, name) / (sigma[name] * np.sqrt(variance))
    return RowNoise(precision, sigma, share)


def _likeliest(square: np.ndarray, relative: np.ndarray) -> tuple[float, float]:
    """Sigma and share of highest likelihood; arguments (N,) are squares of rows and their relative variances."""
    best = np.inf, _LEAST, 0.0
    for share in _SHARES if relative.any() else _SHARES[:1]:
        factor = (1.0 - share) + share * relative
        scaled = square / factor
        scale = max(float(np.median(scaled)), _LEAST**2)
        for _ in range(_ROUNDS):
            weight = (_FREEDOM + 1.0) / (_FREEDOM + scaled / scale)
            scale = max(float((weight * scaled).mean()), _LEAST**2)
        surprise = 0.5 * np.log(scale * factor) + 0.5 * (_FREEDOM + 1.0) * np.log1p(scaled / (_FREEDOM * scale))
        best = min(best, (float(surprise.mean()), float(np.sqrt(scale)), float(share)))
    return best[1:]
