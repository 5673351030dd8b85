"""The batched backend: all points at once in compiled code, parallel over points.

Every point is solved on its own (`one_point`); nothing is formed for all points at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.problem import Problem, State
from connrsfm_graph.solvers.block_cholesky import Structure, analyse
from connrsfm_graph.solvers.interface import Levenberg, Minimum, PairModel
from connrsfm_graph.solvers.one_point import minimise_point
from factors.conformal_pair import ACTIVE, SLOTS
from factors.noise import ROWS, PairNoise


@njit(cache=True, parallel=True)
def _minimise(
    model, frame, log_scale, data, weight, edges, structure, columns, scaled, kappa, precision, huber, limits, single
):
    P = len(frame)
    cost, iterations, solvable = np.empty(P), np.empty(P, dtype=np.int64), np.empty(P, dtype=np.bool_)
    for i in prange(P):
        cost[i], iterations[i], solvable[i] = minimise_point(
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
            limits,
            single,
        )
    return cost, iterations, solvable


class BatchedBackend:
    """All points in compiled code; implements `solvers.interface.Backend`."""

    name = "batched"

    def __init__(self) -> None:
        self._structure: tuple[bytes, int, Structure] | None = None

    def step(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel = PairModel.CONFORMAL,
        damping: float = 0.0,
    ) -> State:
        stepped, _, _, solvable = self._run(problem, state, active, noise, model, Levenberg(1, 0.0, damping), True)
        if not solvable.all():
            point = int(np.argmin(solvable))
            raise ComputationError(
                f"the normal equations of point {point} are not positive definite with active variables "
                f"{''.join(active)} and damping {damping:g}; add damping"
            )
        return stepped

    def minimise(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel = PairModel.CONFORMAL,
        settings: Levenberg = Levenberg(),
    ) -> Minimum:
        minimum, cost, iterations, _ = self._run(problem, state, active, noise, model, settings, False)
        return Minimum(minimum, cost, iterations)

    def _run(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel,
        settings: Levenberg,
        single: bool,
    ) -> tuple[State, np.ndarray, np.ndarray, np.ndarray]:
        columns, scaled = active_columns(active, model)
        frame, log_scale = state.frame.copy(), state.log_scale.copy()
        cost, iterations, solvable = _minimise(
            int(model),
            frame,
            log_scale,
            problem.data,
            problem.weight,
            problem.edges,
            self._analysed(problem),
            columns,
            scaled,
            problem.camera.kappa,
            row_precisions(problem, noise, model),
            noise.huber,
            (settings.max_iterations, settings.tolerance, settings.damping),
            single,
        )
        return State(frame, log_scale), cost, iterations, solvable

    def _analysed(self, problem: Problem) -> Structure:
        signature = problem.edges.tobytes()
        if self._structure is None or self._structure[:2] != (signature, problem.n_frames):
            self._structure = (signature, problem.n_frames, analyse(problem.n_frames, problem.edges))
        return self._structure[2]


def row_precisions(problem: Problem, noise: PairNoise, model: PairModel) -> np.ndarray:
    """(P, E, 21) reciprocal standard deviations of the rows; the isometric pair's first four are all 1."""
    if model == PairModel.CONFORMAL:
        return problem.row_precisions(noise)
    return np.ones((problem.n_points, problem.n_edges, ROWS))


def active_columns(active: tuple[str, ...], model: PairModel) -> tuple[np.ndarray, bool]:
    """Columns (n,) of an image's six variables that are active, and whether the scale is.

    Raises:
        ValueError: a letter is unknown, none is given, or the model does not have the variable.
    """
    allowed = ACTIVE if model == PairModel.CONFORMAL else ("d",)
    if not active or set(active) - set(allowed):
        raise ValueError(f"active variables {active} must be some of {allowed} for the {model.name.lower()} pair")
    columns = [c for letter in "dcb" if letter in active for c in range(*SLOTS[letter][0])]
    return np.array(columns, dtype=np.int64), "s" in active
