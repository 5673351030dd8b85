"""Starting values other than the pre-step, for ablations."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.initialise import initialise
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.problem import Problem, make_problem
from connrsfm_graph.reconstruct import Config, reconstruct
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.synthetic import spheres
from factors.surface import planar_second_order


@pytest.fixture
def problem() -> Problem:
    scene = spheres(n_frames=3, n_points=8)
    edges = np.array([[0, 1], [1, 2]])
    return make_problem(scene.image, scene.tracks.visible, edges, scene.jets(edges), np.ones((2, 8)))


@pytest.mark.parametrize(("start", "value"), [("zeros", 0.0), ("ones", 1.0)])
def test_slopes_are_constant_and_second_order_terms_planar(problem: Problem, start, value: float) -> None:
    state = initialise(problem, BatchedBackend(), start=start)
    assert (state.first_order == value).all()
    np.testing.assert_allclose(state.second_order, planar_second_order(state.first_order, problem.camera))
    assert np.isfinite(state.log_scale).all()


def test_random_slopes_follow_the_seed(problem: Problem) -> None:
    a, b, again = (initialise(problem, BatchedBackend(), start="random", seed=seed).first_order for seed in (0, 1, 0))
    assert np.abs(a).max() <= 1.0
    assert not np.array_equal(a, b)
    np.testing.assert_array_equal(a, again)


def test_the_pre_step_is_the_default(problem: Problem) -> None:
    assert Config().start == "pre-step"
    state = initialise(problem, BatchedBackend())
    assert np.ptp(state.first_order) > 0.0


def test_the_refinement_finds_out_of_a_bad_start() -> None:
    """From slopes of 45 degrees everywhere all views end in wrong shapes alike, and no model fits."""
    tracks = spheres(n_frames=5, n_points=50).tracks
    result, _ = reconstruct(tracks, Config(start="ones"))
    assert evaluate(result.points, tracks.points).e3d_percent < 0.1
