"""Pre-step: first-order terms of every point from isometry and infinitesimal planarity.

Fronto-parallel planes are far enough from most answers to be neutral and near enough for Levenberg-Marquardt, which
converges from them in 10 to 25 iterations. Second-order terms start at those of the tangent planes, scales at the
closed-form value. For ablations the pre-step can be left out and the slopes given instead.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.orthographic import initialise_orthographic
from connrsfm_graph.problem import Problem, State, flat_state, planar_state
from connrsfm_graph.solvers.interface import Backend, Levenberg, PairModel
from factors.conformal_scale import closed_form_log_rho
from factors.noise import PairNoise

Start = Literal["pre-step", "zeros", "ones", "random"]


def initialise(
    problem: Problem,
    backend: Backend,
    settings: Levenberg = Levenberg(),
    start: Start = "pre-step",
    seed: int = 0,
) -> State:
    """Where the differential solve starts.

    Args:
        problem, backend, settings: as for the solve.
        start: `pre-step` solves the isometric pair factors of every point from zeros; the others set all first-order
            terms to 0, to 1, or to random numbers between -1 and 1.
        seed: of the random numbers.

    Raises:
        InputError: zeros with an orthographic camera, whose metrics do not change there to first order.
    """
    if start == "zeros" and not problem.camera.kappa:
        raise InputError("start is 'zeros', from which orthographic cameras lead nowhere; expected another one")
    if start == "pre-step" and not problem.camera.kappa:
        return initialise_orthographic(problem, backend, settings)
    if start == "pre-step":
        minimum = backend.minimise(
            problem, flat_state(problem), ("d",), PairNoise(), model=PairModel.ISOMETRIC, settings=settings
        )
        first_order = minimum.state.first_order
    elif start == "random":
        first_order = np.random.default_rng(seed).uniform(-1.0, 1.0, (*problem.visible.shape, 2))
    else:
        first_order = np.full((*problem.visible.shape, 2), float(start == "ones"))
    state = planar_state(problem, first_order)
    return with_pair_scale(problem, state, PairNoise(extrinsic=np.inf))


def with_pair_scale(problem: Problem, state: State, noise: PairNoise) -> State:
    """As the solve sees scales: in closed form, or known where the camera is orthographic."""
    return with_closed_form_scale(problem, state, noise) if problem.camera.kappa else state


def with_closed_form_scale(problem: Problem, state: State, noise: PairNoise) -> State:
    """Step 4: the conformal scale of every pair, given all else; pairs that do not show it keep their value."""
    precision = problem.row_precisions(noise)
    log_rho = closed_form_log_rho(problem.data, problem.weight, state.frame, problem.edges, precision, problem.camera)
    a, b = problem.edges.T
    depth_ratio = state.log_depth[:, b] - state.log_depth[:, a]
    known = (problem.weight > 0) & np.isfinite(log_rho)
    return state.updated(log_scale=np.where(known, log_rho - problem.camera.kappa * depth_ratio, state.log_scale))
