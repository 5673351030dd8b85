"""Gaussian-process warps: analytic jets, honest leverages and calibrated covariances."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.warps.fitted import leave_one_out, prediction_error
from connrsfm_graph.warps.gaussian_process import fit_gaussian_process, length_scales
from connrsfm_graph.warps.robust import fit_robust, robust_weights
from connrsfm_graph.warps.spline_warp import fit_spline

SCALES = length_scales(1.0)


class RandomField:
    """A draw of the squared-exponential Gaussian process with exact derivatives, by random Fourier features."""

    def __init__(self, rng: np.random.Generator, scale: float, amplitude: float, features: int = 400) -> None:
        self.frequency = rng.normal(size=(features, 2)) / scale
        self.phase = rng.uniform(0, 2 * np.pi, features)
        self.weight = amplitude * np.sqrt(2.0 / features) * rng.normal(size=(features, 2))

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value (N, 2), gradient (N, 2, 2) and second derivatives (N, 2, 3)."""
        angle = x @ self.frequency.T + self.phase
        w, (a, b) = self.weight, self.frequency.T
        second = [-np.cos(angle) * product @ w for product in (a * a, a * b, b * b)]
        first = [-np.sin(angle) * f @ w for f in (a, b)]
        return np.cos(angle) @ w, np.stack(first, axis=-1), np.stack(second, axis=-1)


def noisy_draw(seed: int, n: int, scale: float = 1.6, amplitude: float = 0.3, noise: float = 0.02):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.7, 1.7, (n, 2))
    field = RandomField(rng, scale, amplitude)
    value, gradient, second = field.derivatives(x)
    y = x + value + noise * rng.normal(size=(n, 2))
    jets = np.concatenate([(gradient + np.eye(2)).reshape(n, 4), second.reshape(n, 6)], axis=1)
    return x, y, jets


def test_jets_match_finite_differences_of_the_fitted_warp():
    x, y, _ = noisy_draw(0, 60)
    warp = fit_gaussian_process(x, y, np.ones(60), SCALES)
    places = np.random.default_rng(1).uniform(-1, 1, (10, 2))
    jet = warp.jet(places)
    np.testing.assert_allclose(warp.jet(x).value, y - warp.residual, atol=1e-10)
    for axis in range(2):
        step = 1e-4 * np.eye(2)[axis]
        ahead, behind = warp.jet(places + step), warp.jet(places - step)
        np.testing.assert_allclose(jet.jacobian[..., axis], (ahead.value - behind.value) / 2e-4, atol=1e-6)
        second = (ahead.jacobian - behind.jacobian) / 2e-4
        np.testing.assert_allclose(jet.hessian[..., axis : axis + 2], second, atol=1e-6)


def test_hyper_parameters_are_found():
    noise, scale = [], []
    for seed in range(6):
        x, y, _ = noisy_draw(seed, 120)
        warp = fit_gaussian_process(x, y, np.ones(120), length_scales(0.5))
        noise.append(warp.noise)
        scale.append(warp.settings["length_scale"])
    assert np.mean(noise) == pytest.approx(0.02, rel=0.1)
    assert np.exp(np.mean(np.log(scale))) == pytest.approx(1.6, rel=0.25)


def test_covariance_of_the_jets_is_calibrated():
    normalised = []
    for seed in range(30):
        x, y, jets = noisy_draw(seed, 80)
        warp = fit_gaussian_process(x, y, np.ones(80), SCALES)
        jet = warp.jet(x)
        error = jet.derivatives() - jets
        normalised.append(np.einsum("pi,pij,pj->p", error, np.linalg.inv(jet.covariance), error).mean())
    # 10 degrees of freedom; the uncertainty of the hyper-parameters is not part of the covariance.
    assert 8.0 < np.mean(normalised) < 13.0


def test_covariance_is_symmetric_positive_definite_and_small_where_points_are():
    x, y, _ = noisy_draw(3, 80)
    jet = fit_gaussian_process(x, y, np.ones(80), SCALES).jet(np.array([[0.0, 0.0], [1.6, 1.6]]))
    np.testing.assert_allclose(jet.covariance, jet.covariance.swapaxes(1, 2), rtol=1e-9, atol=1e-12)
    assert (np.linalg.eigvalsh(jet.covariance) > 0).all()
    assert np.trace(jet.covariance[0]) < np.trace(jet.covariance[1])


@pytest.mark.parametrize("model", ["gaussian_process", "bending"])
def test_leave_one_out_is_what_a_refit_predicts(model):
    x, y, _ = noisy_draw(4, 40)

    def fit(keep: np.ndarray):
        weight = np.where(keep, 1.0, 1e-12)
        if model == "bending":
            return fit_spline(x, y, weight, 8, 0.1, bending=1e-3)
        return fit_gaussian_process(x, y, weight, np.array([1.5, 1.6]))

    everything = np.ones(40, dtype=bool)
    whole = fit(everything)
    errors = leave_one_out(whole)
    for p in (0, 17):
        predicted = fit(everything & (np.arange(40) != p)).residual[p]
        # The Gaussian process may choose another noise level without the point.
        np.testing.assert_allclose(errors[p], predicted, rtol=0.1 if model == "gaussian_process" else 1e-6, atol=2e-3)
    assert prediction_error(whole) > np.sqrt((whole.residual**2).mean())


def test_exact_smooth_points_give_exact_derivatives():
    x, y, jets = noisy_draw(5, 150, noise=0.0)
    warp = fit_gaussian_process(x, y, np.ones(150), SCALES)
    inside = np.abs(x).max(axis=1) < 1.3
    error = np.abs(warp.jet(x).derivatives() - jets)[inside]
    assert error[:, :4].max() < 1e-3
    assert error[:, 4:].max() < 1e-2


def test_wrong_tracks_lose_their_weight_and_their_influence():
    x, y, _ = noisy_draw(6, 100)
    clean = fit_robust(x, y, SCALES)
    assert (clean.weight == 1.0).mean() > 0.97
    rng = np.random.default_rng(7)
    wrong = rng.permutation(100)[:15]
    y = y.copy()
    y[wrong] = rng.uniform(-1.7, 1.7, (15, 2))
    robust, plain = fit_robust(x, y, SCALES), fit_gaussian_process(x, y, np.ones(100), SCALES)
    flagged = np.flatnonzero(robust.weight < 0.3)
    assert len(np.intersect1d(flagged, wrong)) >= 13
    assert len(np.setdiff1d(flagged, wrong)) <= 1
    change = [np.abs(warp.jet(x).jacobian - clean.jet(x).jacobian).mean() for warp in (robust, plain)]
    assert change[0] < 0.2 * change[1]


def test_tiny_errors_of_exact_points_are_no_wrong_tracks():
    x, y, _ = noisy_draw(8, 100, noise=0.0)
    y[3] += 1e-4
    warp = fit_gaussian_process(x, y, np.ones(100), SCALES)
    np.testing.assert_array_equal(robust_weights(warp), 1.0)
