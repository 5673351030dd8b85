"""The batched executor takes GTSAM's steps: every set of active variables, weights, robust loss, missing pairs."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import gtsam
import numpy as np
import pytest

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.initialise import initialise
from connrsfm_graph.problem import Problem, State, make_problem
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.gtsam_backend import (
    GtsamBackend,
    full_graph,
    levenberg_marquardt,
    marginal_covariances,
    point_graph,
    write_dot,
)
from connrsfm_graph.solvers.interface import Levenberg, PairModel
from connrsfm_graph.synthetic import spheres
from factors.conformal_pair import ACTIVE
from factors.keys import key
from factors.noise import ROWS, PairNoise
from factors.surface import CAMERAS, PERSPECTIVE, Camera

BATCHED, GTSAM = BatchedBackend(), GtsamBackend()
SETS = [active for size in range(1, 5) for active in combinations(ACTIVE, size)]
NOISES = {
    "plain": PairNoise(),
    "blocks": PairNoise(0.5, 1.0, 2.0),
    "robust": PairNoise(0.5, 1.0, 2.0, huber=0.8),
    "dropped": PairNoise(np.inf, 1.0, 1.0),
}


def random_problem(seed: int = 0, camera: Camera = PERSPECTIVE) -> tuple[Problem, State]:
    """Six points on a loopy graph of five images; pairs are weighted and some are missing, and one whole image."""
    rng = np.random.default_rng(seed)
    edges = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (0, 3), (1, 4)])
    P, F, E = 6, 5, len(edges)
    data = rng.normal(scale=0.2, size=(P, E, 14)) + np.array([0] * 4 + [1, 0, 0, 1] + [0] * 6)
    weight = rng.uniform(0.5, 2, size=(P, E)) * (rng.random((P, E)) < 0.7)
    weight[0, (edges == 2).any(axis=1)] = 0.0
    weight[0, 0] = 1.0
    problem = Problem(rng.normal(size=(P, F, 2)), np.ones((P, F), bool), edges, data, weight, camera)
    return problem, State(rng.normal(scale=0.3, size=(P, F, 6)), rng.normal(scale=0.2, size=(P, E)))


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
@pytest.mark.parametrize("active", SETS, ids=["".join(active) for active in SETS])
def test_steps_agree(active, noise):
    problem, state = random_problem()
    ours = BATCHED.step(problem, state, active, noise, damping=0.01)
    theirs = GTSAM.step(problem, state, active, noise, damping=0.01)
    assert np.abs(ours.frame - theirs.frame).max() < 1e-10
    assert np.abs(ours.log_scale - theirs.log_scale).max() < 1e-10
    assert np.abs(ours.frame - state.frame).max() + np.abs(ours.log_scale - state.log_scale).max() > 1e-3


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES.keys())
@pytest.mark.parametrize("active", [("c",), ("d", "s"), ("d", "c", "s")], ids=["c", "ds", "dcs"])
def test_steps_agree_with_a_precision_for_every_row(active, noise):
    problem, state = random_problem()
    plain = BATCHED.step(problem, state, active, noise, damping=0.01)
    precision = np.random.default_rng(5).uniform(0.2, 5.0, size=(*problem.weight.shape, ROWS))
    problem = replace(problem, precision=precision)
    ours = BATCHED.step(problem, state, active, noise, damping=0.01)
    theirs = GTSAM.step(problem, state, active, noise, damping=0.01)
    assert np.abs(ours.frame - theirs.frame).max() < 1e-10
    assert np.abs(ours.log_scale - theirs.log_scale).max() < 1e-10
    assert np.abs(ours.frame - plain.frame).max() > 1e-3
    # Points keep their precisions when they are solved on their own.
    part = np.array([4, 1])
    alone = BATCHED.step(
        problem.points(part), State(state.frame[part], state.log_scale[part]), active, noise, damping=0.01
    )
    assert (alone.frame == ours.frame[part]).all()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_pre_step_agrees(camera):
    problem, state = random_problem(1, camera)
    ours = BATCHED.minimise(problem, state, ("d",), PairNoise(), PairModel.ISOMETRIC)
    theirs = GTSAM.minimise(problem, state, ("d",), PairNoise(), PairModel.ISOMETRIC)
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-9)
    assert (ours.iterations == theirs.iterations).all()
    assert ours.state.frame == pytest.approx(theirs.state.frame, abs=1e-8)


@pytest.mark.parametrize("active", [("c",), ("d",), ("d", "c", "s")], ids=["step1", "step2", "joint"])
def test_minima_agree(active):
    problem, state = random_problem(2)
    noise = PairNoise(1.0, 3.0, 5.0, huber=2.0)
    ours = BATCHED.minimise(problem, state, active, noise)
    theirs = GTSAM.minimise(problem, state, active, noise)
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-6)
    assert ours.state.frame == pytest.approx(theirs.state.frame, abs=1e-5)


def test_frozen_variables_do_not_move():
    problem, state = random_problem()
    moved = BATCHED.minimise(problem, state, ("c",), PairNoise()).state
    assert (moved.frame[..., [0, 1, 5]] == state.frame[..., [0, 1, 5]]).all()
    assert (moved.log_scale == state.log_scale).all()
    # Images without a usable pair keep their values too.
    bare = ~problem.constrained()
    assert bare.any()
    assert (moved.frame[bare] == state.frame[bare]).all()


def test_freezing_equals_constraining():
    """Leaving variables out of the factors is the same as pinning them in the full graph."""
    problem, state = random_problem()
    graph, values = point_graph(problem, state, 1, ACTIVE, PairNoise())
    for k in values.keys():
        letter = chr(k >> 56)
        if letter != "c":
            pinned = values.atVector(k)
            graph.add(gtsam.PriorFactorVector(k, pinned, gtsam.noiseModel.Constrained.All(len(pinned))))
    constrained = graph.linearize(values).optimize()
    step = BATCHED.step(problem, state, ("c",), PairNoise(), damping=0.0)
    for view in np.flatnonzero(problem.constrained()[1]):
        expected = constrained.at(key("c", 1, int(view)))
        assert (step.second_order - state.second_order)[1, view] == pytest.approx(expected, abs=1e-9)


def test_joint_solve_from_exact_jets_reaches_the_truth():
    scene = spheres()
    F = scene.tracks.n_frames
    edges = np.array([(a, b) for a in range(F) for b in range(a + 1, F)])
    problem = make_problem(scene.image, scene.tracks.visible, edges, scene.jets(edges), np.ones((len(edges), 100)))
    start = initialise(problem, BATCHED)
    solved = BATCHED.minimise(problem, start, ("d", "c", "s"), PairNoise(), settings=Levenberg(100, 1e-9))
    truth = scene.first_order.transpose(1, 0, 2)
    error = np.linalg.norm(solved.state.first_order - truth, axis=-1)
    assert np.median(error) < 1e-8
    assert np.median(np.linalg.norm(start.first_order - truth, axis=-1)) > 1e-2


def test_levenberg_marquardt_agrees_with_gtsams_own():
    problem, state = random_problem(3)
    graph, values = point_graph(problem, state, 0, ("d", "s"), PairNoise())
    _, cost, _ = levenberg_marquardt(graph, values, Levenberg(100, 1e-12))
    reference = gtsam.LevenbergMarquardtOptimizer(graph, values)
    reference.optimize()
    assert cost == pytest.approx(reference.error(), rel=1e-3)
    assert cost <= reference.error()


def test_singular_systems_name_the_point():
    problem, state = random_problem()
    for backend in (BATCHED, GTSAM):
        with pytest.raises(ComputationError, match=r"point \d+ .*add damping"):
            backend.step(problem, state, ("d", "c", "b", "s"), PairNoise(), damping=0.0)


def test_unknown_variables_are_refused():
    problem, state = random_problem()
    for active, model in (((), PairModel.CONFORMAL), (("z",), PairModel.CONFORMAL), (("c",), PairModel.ISOMETRIC)):
        with pytest.raises(ValueError, match="active variables"):
            BATCHED.step(problem, state, active, PairNoise(), model)


def test_marginals_match_the_inverse_of_the_normal_matrix():
    problem, state = random_problem()
    covariances = marginal_covariances(problem, state, 1, ("d",), PairNoise())
    graph, values = point_graph(problem, state, 1, ("d",), PairNoise())
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    hessian = graph.linearize(values).hessian(ordering)[0]
    first = ordering.at(0)
    assert covariances[first] == pytest.approx(np.linalg.inv(hessian)[:2, :2], rel=1e-9)
    with pytest.raises(ComputationError, match="point 1: its pairs do not determine"):
        marginal_covariances(problem, state, 1, ("d", "c", "b", "s"), PairNoise())


def test_full_graph_is_the_sum_of_the_points(tmp_path):
    problem, state = random_problem()
    graph, values = full_graph(problem, state, ("d",), PairNoise())
    assert graph.size() == (problem.weight > 0).sum()
    costs = BATCHED.minimise(problem, state, ("d",), PairNoise(), settings=Levenberg(max_iterations=0)).cost
    assert graph.error(values) == pytest.approx(costs.sum(), rel=1e-12)
    write_dot(graph, tmp_path / "graph.dot")
    assert "first-order terms of point 0, view 1" in (tmp_path / "graph.dot").read_text()
