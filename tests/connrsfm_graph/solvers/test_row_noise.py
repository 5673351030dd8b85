"""Noise of the rows of every pair, estimated from the warps' uncertainty and the misfit of the pre-step's surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.initialise import initialise
from connrsfm_graph.integrate import IntegrationConfig
from connrsfm_graph.problem import make_problem
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.row_noise import _likeliest, estimate_row_noise
from connrsfm_graph.solvers.separable import SolveConfig, solve
from connrsfm_graph.synthetic import spheres
from connrsfm_graph.warps import fit_warps
from factors.noise import EXTRINSIC_ROWS, INTRINSIC_ROWS, METRIC_ROWS, PairNoise

BACKEND, NOISE = BatchedBackend(), SolveConfig().noise


@pytest.fixture(scope="module")
def fitted():
    """Spheres seen through fitted warps: the problem, the warps' jets and the pre-step's state."""
    scene = spheres(n_frames=5)
    edges = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])
    warps = fit_warps(scene.image, scene.tracks.visible, edges)
    problem = make_problem(scene.image, scene.tracks.visible, edges, warps.jets, warps.weight * warps.valid)
    return scene, problem, warps.jets, initialise(problem, BACKEND)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_sigma_and_share_are_those_that_rows_were_drawn_with(share):
    rng = np.random.default_rng(0)
    relative = rng.lognormal(sigma=2.0, size=20000)
    rows = 0.3 * np.sqrt(1.0 - share + share * relative) * rng.standard_t(3, size=20000)
    sigma, found = _likeliest(rows**2, relative)
    assert sigma == pytest.approx(0.3, rel=0.05)
    assert found == pytest.approx(share, abs=0.1)


def test_sigmas_are_of_the_size_of_the_rows(fitted):
    _, problem, jets, start = fitted
    found = estimate_row_noise(problem, jets.covariance, start, NOISE)
    assert found.precision.shape == (*problem.data.shape[:2], 21)
    assert (found.precision > 0).all()
    # Metrics hold for every conformal map, connections ask for second derivatives.
    assert found.sigma["metric"] < 0.5 * found.sigma["intrinsic"]
    # They do not depend on those that were fixed before.
    other = PairNoise(3.0, 2.0, 1.0)
    again = estimate_row_noise(problem, jets.covariance, start, other)
    ours, theirs = (replace(problem, precision=each.precision) for each in (found, again))
    used = problem.weight > 0
    assert ours.row_precisions(NOISE)[used] == pytest.approx(theirs.row_precisions(other)[used], rel=1e-12)


def test_rows_of_uncertain_jets_count_less(fitted):
    _, problem, jets, start = fitted
    covariance = jets.covariance.copy()
    covariance[0, 7] *= 1e4
    before, after = (estimate_row_noise(problem, each, start, NOISE) for each in (jets.covariance, covariance))
    assert before.share["intrinsic"] > 0
    ratio = after.precision / before.precision
    assert (ratio[7, 0, INTRINSIC_ROWS] < 0.1).all()
    ratio[7, 0] = 1.0
    assert ratio == pytest.approx(1.0, abs=0.2)


def test_without_a_covariance_all_pairs_share_their_sigmas(fitted):
    _, problem, _, start = fitted
    found = estimate_row_noise(problem, None, start, NOISE)
    assert set(found.share.values()) == {0.0}
    for block in (METRIC_ROWS, INTRINSIC_ROWS, EXTRINSIC_ROWS):
        assert np.ptp(found.precision[problem.weight > 0][:, block]) < 1e-12


def test_dropped_blocks_stay_dropped(fitted):
    _, problem, jets, start = fitted
    noise = replace(NOISE, extrinsic=np.inf)
    found = estimate_row_noise(problem, jets.covariance, start, noise)
    assert set(found.sigma) == {"metric", "intrinsic"}
    weighed = replace(problem, precision=found.precision)
    assert (weighed.row_precisions(noise)[..., EXTRINSIC_ROWS] == 0).all()


def test_the_solve_gains_on_fitted_warps(fitted):
    scene, problem, jets, start = fitted
    truth = scene.first_order.transpose(1, 0, 2)

    def error(sigmas):
        config = SolveConfig(sigmas=sigmas)
        solved = solve(problem, start, BACKEND, config, IntegrationConfig(), covariance=jets.covariance)
        assert (solved.weighed(problem).precision is None) == (solved.weight is None) == (sigmas == "fixed")
        return np.sqrt(((solved.state.first_order - truth) ** 2).mean())

    assert error("warps") < 0.9 * error("fixed")


def _exact():
    scene = spheres()
    edges = np.array([(a, b) for a in range(7) for b in range(a + 1, 7)])
    problem = make_problem(scene.image, scene.tracks.visible, edges, scene.jets(edges), np.ones((len(edges), 100)))
    return scene.first_order.transpose(1, 0, 2), problem, initialise(problem, BACKEND)


def test_exact_jets_lead_every_point_to_the_truth():
    truth, problem, start = _exact()
    solved = solve(problem, start, BACKEND, SolveConfig(sigmas="warps"), IntegrationConfig())
    assert np.abs(solved.state.first_order - truth).max() < 1e-2
    fixed = solve(problem, start, BACKEND, SolveConfig(sigmas="fixed"), IntegrationConfig())
    # Not so with one sigma for all: points in a wrong minimum bend the surface from which they would start again.
    assert np.abs(fixed.state.first_order - truth).max() > 0.1


def test_the_separable_schedule_takes_them_too():
    truth, problem, start = _exact()
    config = SolveConfig(schedule="separable", sigmas="warps")
    solved = solve(problem, start, BACKEND, config, IntegrationConfig())
    assert (np.diff(solved.cost_history) < 0).all()
    before, after = (np.median(np.abs(state.first_order - truth)) for state in (start, solved.state))
    assert after < before
