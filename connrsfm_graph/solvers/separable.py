"""The two schedules of the differential solve: separable steps 1 to 4, and all pair variables jointly.

Separable (the paper's): with everything else frozen, each of N_t outer iterations solves

    step 1   second-order terms   per point
    step 2   first-order terms    per point
    step 3   depth                per image, by integration
    step 4   conformal scale      per pair, in closed form

Freezing keeps every step small and well conditioned but makes the descent slow. The joint mode lets first- and
second-order terms and scales of a point move together, which reaches the exact solution from exact warps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.initialise import with_pair_scale
from connrsfm_graph.integrate import Integrated, IntegrationConfig, balance_scales, integrate
from connrsfm_graph.problem import Problem, State
from connrsfm_graph.solvers.interface import Backend, Levenberg, Minimum
from connrsfm_graph.solvers.marginals import certainty
from connrsfm_graph.solvers.row_noise import RowNoise, estimate_row_noise
from factors.noise import PairNoise

JOINT = ("d", "c", "s")
"""Active variables of the joint schedule; depths follow by integration, since pair factors do not see them."""
JOINT_KNOWN_SCALE = ("d", "c")
"""The same for orthographic cameras: with the scale of a pair free, its metric would fit every slope."""
OFF_SURFACE = 3.0
"""Misfit of a point's first-order terms, in medians over all, from which it starts again from the surface."""
RESTART_GAIN = 1e-3
"""Relative decrease of a point's cost that counts as a better minimum."""


@dataclass(frozen=True)
class SolveConfig:
    """Differential solve with the 21-row pair factors, after the pre-step."""

    schedule: Literal["joint", "separable", "none"] = "joint"
    """All variables of a point together, the paper's steps 1 to 4, or the pre-step alone."""
    backend: Literal["batched", "gtsam"] = "batched"
    """Compiled executor, or per-point GTSAM graphs (slower, the same steps)."""
    outer_iterations: int = 3
    """N_t, rounds of steps 1 to 4; separable only."""
    restarts: int = 2
    """Rounds in which points start again from the surface through all points; joint only."""
    sigmas: Literal["fixed", "warps"] = "fixed"
    """Sigmas of the rows: those of `noise` for all pairs, or those of every pair from the uncertainty of its warp and
    the misfit of the pre-step's surfaces; then terms are integrated by how sure they are, too. Surfaces that are not
    refined are better for it or as good (see `experiments sigmas`), refined ones of noisy tracks slightly worse."""
    noise: PairNoise = PairNoise(intrinsic=10.0, extrinsic=30.0)
    """Fixed sigmas of the metric, intrinsic and extrinsic rows (inf drops a block in either case), and the robust
    threshold."""
    levenberg: Levenberg = Levenberg()
    """Settings of every minimisation."""

    def __post_init__(self) -> None:
        if self.outer_iterations < 1:
            raise InputError(f"solve.outer_iterations is {self.outer_iterations}, expected at least 1")
        if self.restarts < 0:
            raise InputError(f"solve.restarts is {self.restarts}, expected 0 or more")
        if np.isinf(self.noise.metric):
            raise InputError("solve.noise.metric is inf, expected a positive number: metrics fix the scales")


@dataclass(frozen=True)
class Solved:
    """Outcome of a schedule."""

    state: State
    """First- and second-order terms, depths and scales, scales of the images balanced."""
    integrated: Integrated
    """The last integration."""
    cost_history: list[float] = field(default_factory=list)
    """Total cost of the pair factors: at the start and after every outer iteration."""
    index_history: list[float] = field(default_factory=list)
    """Convergence index after every outer iteration: change of the cost relative to the cost before."""
    row_noise: RowNoise | None = None
    """Noise of the rows of every pair as estimated; None where it was fixed."""
    weight: np.ndarray | None = None
    """(P, F) weight of each point's first-order terms in the last integration; None for 1."""

    def weighed(self, problem: Problem) -> Problem:
        """The problem that was solved, with the precisions of its rows."""
        return problem if self.row_noise is None else replace(problem, precision=self.row_noise.precision)


def solve(
    problem: Problem,
    start: State,
    backend: Backend,
    config: SolveConfig,
    integration: IntegrationConfig,
    progress: Callable[[int, int], None] | None = None,
    covariance: np.ndarray | None = None,
) -> Solved:
    """Run the configured schedule from the pre-step's state.

    Args:
        problem, start, backend, config, integration: the measurements, where to start, and how to solve.
        progress: called with (rounds done, rounds).
        covariance: (E, P, 10, 10) of the warps' jets, see `factors.warp_jet.WarpJet`; None where it is not known.
    """
    rows = None
    if config.sigmas == "warps" and config.schedule != "none":
        rows = estimate_row_noise(problem, covariance, start, config.noise)
        problem = replace(problem, precision=rows.precision)
    schedule = _separable if config.schedule == "separable" else _joint
    return replace(schedule(problem, start, backend, config, integration, progress), row_noise=rows)


def _joint(
    problem: Problem,
    start: State,
    backend: Backend,
    config: SolveConfig,
    integration: IntegrationConfig,
    progress: Callable[[int, int], None] | None,
) -> Solved:
    """All variables of a point together; the start itself where the schedule is `none`."""
    state, costs, weight = start, [], None
    if config.schedule == "joint":
        costs.append(total_cost(problem, state, backend, config.noise))
        minimum = backend.minimise(problem, state, active_variables(problem), config.noise, settings=config.levenberg)
        costs.append(float(minimum.cost.sum()))
        for _ in range(config.restarts):
            minimum, improved = _restart_from_surface(problem, minimum, backend, config)
            costs.append(float(minimum.cost.sum()))
            if not improved:
                break
        state, weight = minimum.state, _weight(problem, minimum, config.noise)
    integrated = integrate(problem, state, integration, weight)
    state = balance_scales(problem, _with_depth(problem, state, integrated, config.noise))
    return Solved(state, integrated, costs, _indices(costs), weight=weight)


def _restart_from_surface(
    problem: Problem, minimum: Minimum, backend: Backend, config: SolveConfig
) -> tuple[Minimum, bool]:
    """Start points that disagree with the surface through all points again from it; keep the better of both minima.

    A point's cost has several minima (a patch seen concave or convex); its neighbours know which is right.
    """
    surface = integrate(problem, minimum.state, weight=_weight(problem, minimum, config.noise))
    misfit = np.linalg.norm(minimum.state.first_order - surface.first_order, axis=-1) * problem.constrained()
    again = np.flatnonzero(misfit.max(axis=1) > OFF_SURFACE * np.median(misfit[misfit > 0]))
    start = minimum.state.updated(first_order=surface.first_order, second_order=surface.second_order)
    start = State(start.frame[again], start.log_scale[again])
    part = problem.points(again)
    start = with_pair_scale(part, start, config.noise)
    trial = backend.minimise(part, start, active_variables(part), config.noise, settings=config.levenberg)
    better = trial.cost < (1.0 - RESTART_GAIN) * minimum.cost[again]
    chosen = again[better]
    kept = Minimum(minimum.state.updated(), minimum.cost.copy(), minimum.iterations.copy())
    kept.state.frame[chosen], kept.state.log_scale[chosen] = trial.state.frame[better], trial.state.log_scale[better]
    kept.cost[chosen] = trial.cost[better]
    kept.iterations[again] += trial.iterations
    return kept, bool(better.any())


def _weight(problem: Problem, minimum: Minimum, noise: PairNoise) -> np.ndarray | None:
    """(P, F) weight of first-order terms: how sure they are, which rows that are all of one sigma do not tell."""
    return None if problem.precision is None else certainty(problem, minimum, active_variables(problem), noise)


def total_cost(problem: Problem, state: State, backend: Backend, noise: PairNoise) -> float:
    """Cost of all pair factors at a state."""
    at_start = Levenberg(max_iterations=0)
    return float(backend.minimise(problem, state, JOINT, noise, settings=at_start).cost.sum())


def _separable(
    problem: Problem,
    state: State,
    backend: Backend,
    config: SolveConfig,
    integration: IntegrationConfig,
    progress: Callable[[int, int], None] | None,
) -> Solved:
    noise, settings = config.noise, config.levenberg
    costs = [total_cost(problem, state, backend, noise)]
    for iteration in range(config.outer_iterations):
        state = backend.minimise(problem, state, ("c",), noise, settings=settings).state
        state = backend.minimise(problem, state, ("d",), noise, settings=settings).state
        integrated = integrate(problem, state, integration)
        state = balance_scales(problem, _with_depth(problem, state, integrated, noise))
        costs.append(total_cost(problem, state, backend, noise))
        if progress is not None:
            progress(iteration + 1, config.outer_iterations)
    return Solved(state, integrated, costs, _indices(costs))


def _with_depth(problem: Problem, state: State, integrated: Integrated, noise: PairNoise) -> State:
    return with_pair_scale(problem, state.updated(log_depth=integrated.log_depth), noise)


def active_variables(problem: Problem) -> tuple[str, ...]:
    """What the joint schedule minimises over."""
    return JOINT if problem.camera.kappa else JOINT_KNOWN_SCALE


def _indices(costs: list[float]) -> list[float]:
    return [abs(after - before) / max(before, np.finfo(float).tiny) for before, after in pairwise(costs)]
