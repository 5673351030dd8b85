"""Separable and joint schedules on exact data, and what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.initialise import initialise, with_closed_form_scale
from connrsfm_graph.integrate import IntegrationConfig
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.problem import make_problem
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.interface import Levenberg
from connrsfm_graph.solvers.separable import SolveConfig, solve
from connrsfm_graph.synthetic import spheres
from factors.noise import PairNoise
from factors.surface import PERSPECTIVE

BACKEND = BatchedBackend()


@pytest.fixture(scope="module")
def exact():
    scene = spheres()
    F = scene.tracks.n_frames
    edges = np.array([(a, b) for a in range(F) for b in range(a + 1, F)])
    problem = make_problem(scene.image, scene.tracks.visible, edges, scene.jets(edges), np.ones((len(edges), 100)))
    return scene, problem, initialise(problem, BACKEND)


def _error(scene, solved):
    points = PERSPECTIVE.points(scene.image, np.exp(solved.state.log_depth.T))
    return evaluate(points, scene.tracks.points).e3d_percent


def test_joint_reaches_the_truth_from_exact_jets(exact):
    scene, problem, start = exact
    config = SolveConfig(noise=PairNoise(), levenberg=Levenberg(100, 1e-9))
    joint = solve(problem, start, BACKEND, config, IntegrationConfig())
    none = solve(problem, start, BACKEND, SolveConfig(schedule="none"), IntegrationConfig())
    assert _error(scene, joint) < 0.1
    assert _error(scene, none) > 1.0


def test_separable_lowers_the_cost_with_every_round(exact):
    _, problem, start = exact
    config = SolveConfig(schedule="separable", outer_iterations=4, noise=PairNoise())
    rounds = []
    solved = solve(
        problem, start, BACKEND, config, IntegrationConfig(), lambda done, total: rounds.append((done, total))
    )
    assert rounds == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len(solved.cost_history) == 5
    assert (np.diff(solved.cost_history) < 0).all()
    expected = [1 - after / before for before, after in zip(solved.cost_history, solved.cost_history[1:], strict=False)]
    assert solved.index_history == pytest.approx(expected)


def test_scales_of_the_images_are_balanced(exact):
    scene, problem, start = exact
    solved = solve(problem, start, BACKEND, SolveConfig(noise=PairNoise()), IntegrationConfig())
    medians = np.median(solved.state.log_scale, axis=0)
    assert np.abs(medians).max() < 0.05
    assert solved.state.log_depth.mean() == pytest.approx(0, abs=1e-9)
    # In that gauge the scale of a pair is the true one, up to the ratio of the images' own scales.
    truth = np.log(scene.conformal_scale(problem.edges)).T
    assert np.median(np.abs((solved.state.log_scale - medians) - (truth - np.median(truth, axis=0)))) < 0.02


def test_closed_form_scale_keeps_what_it_cannot_see(exact):
    _, problem, start = exact
    nothing = PairNoise(metric=np.inf, extrinsic=np.inf)
    kept = with_closed_form_scale(problem, start.updated(log_scale=start.log_scale + 0.25), nothing)
    assert kept.log_scale == pytest.approx(start.log_scale + 0.25)
