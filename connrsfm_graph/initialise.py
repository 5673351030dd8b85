"""Pre-step: first-order terms of every point from isometry and infinitesimal planarity.

Fronto-parallel planes are far enough from most answers to be neutral and near enough for Levenberg-Marquardt, which
converges from them in 10 to 25 iterations. Second-order terms start at those of the tangent planes, scales at the
closed-form value.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.problem import Problem, State, flat_state, planar_state
from connrsfm_graph.solvers.interface import Backend, Levenberg, PairModel
from factors.conformal_scale import closed_form_log_rho
from factors.noise import PairNoise


def initialise(problem: Problem, backend: Backend, settings: Levenberg = Levenberg()) -> State:
    """Solve the isometric pair factors of every point from zeros."""
    minimum = backend.minimise(
        problem, flat_state(problem), ("d",), PairNoise(), model=PairModel.ISOMETRIC, settings=settings
    )
    state = planar_state(problem, minimum.state.first_order)
    return with_closed_form_scale(problem, state, PairNoise(extrinsic=np.inf))


def with_closed_form_scale(problem: Problem, state: State, noise: PairNoise) -> State:
    """Step 4: the conformal scale of every pair, given all else; pairs that do not show it keep their value."""
    log_rho = closed_form_log_rho(problem.data, problem.weight, state.frame, problem.edges, noise, problem.camera)
    a, b = problem.edges.T
    depth_ratio = state.log_depth[:, b] - state.log_depth[:, a]
    known = (problem.weight > 0) & np.isfinite(log_rho)
    return state.updated(log_scale=np.where(known, log_rho - problem.camera.kappa * depth_ratio, state.log_scale))
