"""Integration of exact and noisy gradients; points without terms; images that cannot be integrated."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.integrate import IntegrationConfig, integrate
from connrsfm_graph.problem import flat_state, make_problem
from connrsfm_graph.surface_spline import terms_of_depth
from connrsfm_graph.synthetic import isometric_bending
from factors.surface import PERSPECTIVE

EDGES = np.array([(0, 1), (1, 2), (2, 3)])


@pytest.fixture(scope="module")
def exact():
    scene = isometric_bending(n_frames=4, n_points=150, bend=0.4)
    problem = make_problem(scene.image, scene.tracks.visible, EDGES, scene.jets(EDGES), np.ones((3, 150)))
    state = flat_state(problem).updated(
        first_order=scene.first_order.transpose(1, 0, 2), second_order=scene.second_order.transpose(1, 0, 2)
    )
    return scene, problem, state


def _error(scene, log_depth, points=slice(None)):
    difference = (log_depth - scene.log_depth.T)[points]
    return (difference - difference.mean(axis=0)).std()


@pytest.mark.parametrize("method", ["spline", "graph"])
def test_exact_gradients(exact, method):
    scene, problem, state = exact
    found = integrate(problem, state, IntegrationConfig(method=method))
    assert _error(scene, found.log_depth) < 2e-3
    assert found.log_depth.mean(axis=0) == pytest.approx(0, abs=1e-9)


def test_smoothing_is_chosen_from_the_data(exact):
    scene, problem, state = exact
    noise = np.random.default_rng(0).normal(scale=0.3, size=state.first_order.shape)
    noisy = state.updated(first_order=state.first_order + noise)
    chosen = integrate(problem, noisy)
    assert chosen.bending > 100 * integrate(problem, state).bending
    errors = {
        mu: _error(scene, integrate(problem, noisy, IntegrationConfig(bending=mu)).log_depth) for mu in (1e-9, 1e1)
    }
    assert _error(scene, chosen.log_depth) < min(errors.values())


def test_wrong_terms_of_some_points_are_outweighed(exact):
    scene, problem, state = exact
    wrong = state.first_order.copy()
    wrong[::15] += 3.0
    found = {
        huber: _error(
            scene, integrate(problem, state.updated(first_order=wrong), IntegrationConfig(huber=huber)).log_depth
        )
        for huber in (2.0, np.inf)
    }
    assert found[2.0] < 0.25 * found[np.inf]


def test_points_without_a_pair_lie_on_the_surface(exact):
    scene, _, state = exact
    weight = np.ones((3, 150))
    weight[:, ::10] = 0.0
    bare = make_problem(scene.image, scene.tracks.visible, EDGES, scene.jets(EDGES), weight)
    assert not bare.constrained()[::10].any()
    first = state.first_order.copy()
    first[::10] = 0.0
    found = integrate(bare, state.updated(first_order=first))
    assert _error(scene, found.log_depth, slice(0, None, 10)) < 5e-3


def test_images_with_too_few_points_are_named(exact):
    scene, _, state = exact
    weight = np.ones((3, 150))
    weight[2, 2:] = 0.0
    bare = make_problem(scene.image, scene.tracks.visible, EDGES, scene.jets(EDGES), weight)
    with pytest.raises(ComputationError, match="image 3 has 2 points with first-order terms"):
        integrate(bare, state)


def test_terms_of_given_depths(exact):
    scene, *_ = exact
    first, second, _ = terms_of_depth(scene.image, scene.log_depth, scene.tracks.visible, PERSPECTIVE)
    inner = np.linalg.norm(scene.image - scene.image.mean(axis=1, keepdims=True), axis=-1) < 0.1
    assert np.abs(first - scene.first_order)[inner].max() < 0.02
    assert np.median(np.abs(second - scene.second_order)[inner]) < 0.1
