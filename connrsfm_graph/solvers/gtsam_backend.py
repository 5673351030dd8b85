"""The GTSAM backend: a real `NonlinearFactorGraph` of pair factors per point.

Frozen variables are not in the factors. Levenberg-Marquardt is driven from Python (`linearize`, `error`, `retract`):
GTSAM's own optimisers copy the whole `Values` for every callback of a Python factor. Use this backend as reference,
for marginals and to put pair factors into a graph of your own; the batched backend takes the same steps faster.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.problem import Problem, State
from connrsfm_graph.solvers.batched import active_columns
from connrsfm_graph.solvers.interface import MAX_DAMPING, MIN_DAMPING, VANISHING_COST, Levenberg, Minimum, PairModel
from factors import keys
from factors.conformal_pair import SLOTS, conformal_pair_factor
from factors.isometric_pair import isometric_pair_factor
from factors.noise import PairNoise

VECTORS = {letter: slice(*SLOTS[letter][0]) for letter in "dcb"}


def point_graph(
    problem: Problem,
    state: State,
    point: int,
    active: tuple[str, ...],
    noise: PairNoise,
    model: PairModel = PairModel.CONFORMAL,
    checked: bool = False,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The subgraph of one point: a pair factor for each usable edge, and the values of its active variables.

    Frozen variables are read from `state` now; build the graph again after changing them.
    """
    active_columns(active, model)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for edge in np.flatnonzero(problem.weight[point] > 0):
        a, b = (int(view) for view in problem.edges[edge])
        weight = float(problem.weight[point, edge])
        data = problem.data[point, edge]
        if model == PairModel.ISOMETRIC:
            sigma: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(4, weight**-0.5)
            if np.isfinite(noise.huber):
                sigma = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(noise.huber), sigma)
            factor = isometric_pair_factor(point, (a, b), data, sigma, problem.camera)
        else:
            factor = conformal_pair_factor(
                point,
                int(edge),
                (a, b),
                data,
                state.pair(point, int(edge), (a, b)),
                active=active,
                noise=noise.model(weight, None if problem.precision is None else problem.precision[point, edge]),
                camera=problem.camera,
                checked=checked,
            )
        graph.add(factor)
        for key in factor.keys():
            if not values.exists(key):
                values.insert(key, _value(state, key))
    return graph, values


def full_graph(
    problem: Problem, state: State, active: tuple[str, ...], noise: PairNoise, model: PairModel = PairModel.CONFORMAL
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """One graph with the pair factors of every point (points do not share variables)."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for point in range(problem.n_points):
        part, part_values = point_graph(problem, state, point, active, noise, model)
        graph.push_back(part)
        values.insert(part_values)
    return graph, values


def write_dot(graph: gtsam.NonlinearFactorGraph, path: Path) -> None:
    """Write a graph in Graphviz' dot language, variables named in words."""
    no_places = gtsam.Values()  # GTSAM would place variables in the drawing by what their values are
    path.write_text(graph.dot(no_places, keys.describe), encoding="utf-8")


def marginal_covariances(
    problem: Problem, state: State, point: int, active: tuple[str, ...], noise: PairNoise
) -> dict[int, np.ndarray]:
    """Marginal covariance of every active variable of a point, by key (decode with `factors.keys`).

    Raises:
        ComputationError: the point's variables are not all determined by its pairs.
    """
    graph, values = point_graph(problem, state, point, active, noise)
    try:
        marginals = gtsam.Marginals(graph, values)
        return {key: marginals.marginalCovariance(key) for key in values.keys()}
    except RuntimeError as error:
        raise ComputationError(
            f"point {point}: its pairs do not determine all of {''.join(active)}; add a prior or freeze some"
        ) from error


class GtsamBackend:
    """Per-point GTSAM graphs; implements `solvers.interface.Backend`."""

    name = "gtsam"

    def step(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel = PairModel.CONFORMAL,
        damping: float = 0.0,
    ) -> State:
        result = state.updated()
        for point, graph, values in _subgraphs(problem, state, active, noise, model):
            ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
            try:
                delta = damped(graph.linearize(values), values, damping).optimize(ordering)
            except RuntimeError as error:
                raise ComputationError(
                    f"the normal equations of point {point} are not positive definite with active variables "
                    f"{''.join(active)} and damping {damping:g}; add damping"
                ) from error
            _store(result, values.retract(delta))
        return result

    def minimise(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel = PairModel.CONFORMAL,
        settings: Levenberg = Levenberg(),
    ) -> Minimum:
        result = state.updated()
        cost, iterations = np.zeros(problem.n_points), np.zeros(problem.n_points, dtype=int)
        for point, graph, values in _subgraphs(problem, state, active, noise, model):
            values, cost[point], iterations[point] = levenberg_marquardt(graph, values, settings)
            _store(result, values)
        return Minimum(result, cost, iterations)


def levenberg_marquardt(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, settings: Levenberg = Levenberg()
) -> tuple[gtsam.Values, float, int]:
    """Levenberg-Marquardt driven from Python, by the rule of `solvers.interface`.

    Returns:
        Final values, cost and number of accepted steps.
    """
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    cost, damping, iterations = graph.error(values), settings.damping, 0
    while iterations < settings.max_iterations and cost > VANISHING_COST:
        linear = graph.linearize(values)
        while True:
            try:
                trial = values.retract(damped(linear, values, damping).optimize(ordering))
                new = graph.error(trial)
            except (RuntimeError, ValueError):  # indeterminate system, or a residual that is not a number
                new = np.inf
            if new <= cost:
                break
            damping *= 10.0
            if damping > MAX_DAMPING:
                return values, cost, iterations
        decrease, cost, values = cost - new, new, trial
        damping = max(damping / 10.0, MIN_DAMPING)
        iterations += 1
        if decrease <= settings.tolerance * cost:
            break
    return values, cost, iterations


def _subgraphs(
    problem: Problem, state: State, active: tuple[str, ...], noise: PairNoise, model: PairModel
) -> Iterator[tuple[int, gtsam.NonlinearFactorGraph, gtsam.Values]]:
    for point in range(problem.n_points):
        graph, values = point_graph(problem, state, point, active, noise, model)
        if graph.size():
            yield point, graph, values


def damped(linear: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float) -> gtsam.GaussianFactorGraph:
    """The linear graph with `damping` added to the diagonal of its normal equations."""
    if damping == 0.0:
        return linear
    damped = gtsam.GaussianFactorGraph()
    damped.push_back(linear)
    zero = values.zeroVectors()
    for key in values.keys():
        size = zero.at(key).size
        unit = gtsam.noiseModel.Unit.Create(size)
        damped.add(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(size), np.zeros(size), unit))
    return damped


def _value(state: State, key: int) -> np.ndarray:
    letter, point, second = keys.decode(key)
    if letter == keys.LOG_SCALE:
        return state.log_scale[point, second : second + 1].copy()
    return state.frame[point, second, VECTORS[letter]].copy()


def _store(state: State, values: gtsam.Values) -> None:
    for key in values.keys():
        letter, point, second = keys.decode(key)
        if letter == keys.LOG_SCALE:
            state.log_scale[point, second] = values.atVector(key)[0]
        else:
            state.frame[point, second, VECTORS[letter]] = values.atVector(key)
