"""Depths that were integrated and not refined say honestly how sure they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from connrsfm_graph import depth_deviation
from connrsfm_graph.integrate import Integrated, IntegrationConfig, integrate
from connrsfm_graph.problem import make_problem, planar_state
from connrsfm_graph.reconstruct import default_config, reconstruct
from connrsfm_graph.solvers.separable import SolveConfig, Solved
from connrsfm_graph.synthetic import isometric_bending, with_missing, with_noise


def test_covariances_of_terms_are_propagated_as_integration_propagates_errors(monkeypatch):
    """Terms drawn 200 times: the normalised squared error of a depth is in the 95 % interval of chi-squared."""
    scene, edges = isometric_bending(3, 40, seed=1), np.array([(0, 1), (1, 2)])
    visible = scene.tracks.visible.copy()
    visible[1, :5] = False
    problem = make_problem(scene.image, visible, edges, scene.jets(edges), np.ones((2, 40)))
    rng, runs, total = np.random.default_rng(0), 200, 0.0
    spread = 0.02 * rng.normal(size=(40, 3, 2, 2))
    monkeypatch.setattr(depth_deviation, "_of_terms", lambda *_: spread @ np.swapaxes(spread, -1, -2))
    monkeypatch.setattr(depth_deviation, "_factor", lambda *_: 1.0)
    settings = IntegrationConfig(bending=1e-3, huber=np.inf)
    true = planar_state(problem, np.moveaxis(scene.first_order, 0, 1))
    exact = integrate(problem, true, settings)
    deviation = _deviation(problem, true, exact, settings)
    assert (deviation[~problem.visible] == 0).all()
    for _ in range(runs):
        noise = np.einsum("pfij,pfj->pfi", spread, rng.normal(size=(40, 3, 2)))
        drawn = integrate(problem, true.updated(first_order=true.first_order + noise), settings)
        point, view = rng.choice(np.argwhere(problem.visible))
        total += ((drawn.log_depth - exact.log_depth)[point, view] / deviation[point, view]) ** 2
    low, high = chi2.ppf([0.025, 0.975], runs) / runs
    assert low < total / runs < high


def _deviation(problem, state, integrated: Integrated, settings):
    solved = Solved(state.updated(log_depth=integrated.log_depth), integrated)
    return depth_deviation.depth_deviation(problem, solved, SolveConfig(), settings, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["default", "paper"])
def test_depths_that_are_not_refined_are_calibrated(mode):
    """200 surfaces of 20 scenes: the mean normalised squared error is 1 within its 95 % interval."""
    config, means = replace(default_config(mode), refinement=False), []
    for seed in range(20):
        tracks = with_noise(isometric_bending(10, 50, seed=seed).tracks, 1.0, seed)
        result, _ = reconstruct(tracks, config)
        error = np.log(result.depth) - np.log(tracks.points[..., 2])
        error -= error.mean(axis=1, keepdims=True)
        means.append((error**2 / (result.depth_std / result.depth) ** 2).mean())
    assert abs(np.mean(means) - 1.0) < 1.96 * np.std(means, ddof=1) / np.sqrt(len(means))


@pytest.mark.parametrize("settings", [{"schedule": "none"}, {"schedule": "joint"}])
def test_every_depth_says_how_sure_it_is(settings):
    tracks = with_missing(with_noise(isometric_bending(6, 40, seed=3).tracks, 1.0), 0.3)
    result, _ = reconstruct(tracks, replace(default_config(), refinement=False, solve=SolveConfig(**settings)))
    assert (result.depth_std[result.recovered] > 0).all()
    assert np.isnan(result.depth_std[~result.recovered]).all()


def test_noisier_tracks_are_less_sure():
    scene, config = isometric_bending(8, 40, seed=2), replace(default_config(), refinement=False)
    quiet, noisy = (reconstruct(with_noise(scene.tracks, sigma), config)[0] for sigma in (0.2, 4.0))
    assert np.median(noisy.depth_std) > 2.0 * np.median(quiet.depth_std)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_point_may_be_tracked_twice():
    """It has no length to itself: nothing is divided by zero."""
    tracks = with_noise(isometric_bending(6, 30, seed=3).tracks, 1.0).select(points=[*range(30), 0, 1, 2])
    result, _ = reconstruct(tracks, replace(default_config(), refinement=False))
    assert (result.depth_std[result.recovered] > 0).all()
