"""Prediction of image points that a fit was not given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, held_out, refine, settle
from connrsfm_graph.refine.held_out import HeldOut, gain, part_gained, within
from connrsfm_graph.refine.measurements import Measurements, Shape
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.solve import minimise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, with_noise

PIXELS = 2.0


def fitted(
    *length_sigmas: float, n_frames: int = 6, n_points: int = 60, pixels: float = PIXELS
) -> tuple[Measurements, Shape, np.ndarray, float]:
    """A fit to noisy image points of an isometric scene, what is seen, and the standard deviation of the noise.

    The fit is one with the last of the noise levels of lengths, from fits with those before it.
    """
    scene = isometric_bending(n_frames, n_points, seed=1)
    tracks = with_noise(scene.tracks, pixels, seed=1)
    sigma = pixels / tracks.focal_length()
    completed = complete(tracks.normalised(), tracks.visible, scene.log_depth)
    task = Task.of(completed, tracks.visible, RefineConfig())
    shape = start_shape(task.completed, task.mesh)
    for length_sigma in length_sigmas:
        noise = replace(Noise.start(sigma, length_sigma, task.spacing()), turns=True)
        measurements = task.measurements(noise, conformal=False)
        shape, _ = minimise(measurements, shape, 30, 1e-4)
    return measurements, shape, tracks.visible, sigma


def prediction_errors(measurements: Measurements, shape: Shape, seen: np.ndarray) -> np.ndarray:
    """Of the first fits without a part of the points."""
    return HeldOut(shape, seen).errors(measurements)


def test_points_left_out_are_predicted_to_about_their_noise() -> None:
    measurements, shape, seen, sigma = fitted(0.01)
    errors = prediction_errors(measurements, shape, seen)
    assert 0.5 * seen.sum() < len(errors) < 0.7 * seen.sum()
    assert 2 * sigma**2 < errors.mean() < 5 * sigma**2  # more than the fit's own corrections, of which it knows
    assert (shape.correction**2).sum(axis=-1).mean() < 0.9 * errors.mean()
    np.testing.assert_array_equal(errors, prediction_errors(measurements, shape, seen))


def test_no_more_points_are_left_out_than_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    measurements, shape, seen, _ = fitted(0.01)
    errors = prediction_errors(measurements, shape, seen)
    monkeypatch.setattr(held_out, "_ENOUGH", 50)
    fewer = prediction_errors(measurements, shape, seen)
    assert 50 <= len(fewer) < 0.3 * seen.sum()
    np.testing.assert_array_equal(fewer, errors[: len(fewer)])


def test_what_a_point_left_out_says_is_not_used() -> None:
    """An image point that is moved, and left out, is predicted where it was, and others hardly notice."""
    measurements, shape, seen, sigma = fitted(0.01)
    before = prediction_errors(measurements, shape, seen)
    # The first part left out is where the errors come first.
    part = np.random.default_rng(0).integers(5, size=seen.shape)
    frame, point = np.argwhere(part == 0)[0]
    image = measurements.image.copy()
    image[frame, point, 0] += 50 * sigma
    after = prediction_errors(replace(measurements, image=image), shape, seen)
    assert np.sqrt(after[0]) == pytest.approx(50 * sigma, abs=5 * sigma)
    first = np.count_nonzero(part == 0)
    np.testing.assert_allclose(after[1:first], before[1:first], atol=sigma**2)


def test_lengths_that_hold_little_predict_worse() -> None:
    some, little = (
        prediction_errors(*fitted(length, n_frames=12, n_points=100, pixels=1.0)[:3]) for length in (0.003, 0.1)
    )
    assert gain(some, little)[0] > 0.05 * some.mean()
    assert not within(1.0, little, some)


def test_gross_errors_do_not_decide() -> None:
    errors = np.random.default_rng(0).chisquare(2, 500)
    wild = errors.copy()
    wild[::50] *= 1e6
    assert gain(errors, errors) == (0.0, 0.0)
    mean, deviation = gain(0.9 * errors, errors)
    assert mean == pytest.approx(0.1 * errors.mean(), rel=0.02)
    assert deviation == pytest.approx(0.1 * errors.std() / np.sqrt(500), rel=0.1)
    assert 0.0 < gain(0.9 * errors, 0.9 * wild)[0] < errors.mean()
    assert gain(errors[:0], errors[:0]) == (0.0, 0.0)


def test_what_is_worse_by_chance_is_within_one_deviation() -> None:
    rng = np.random.default_rng(0)
    errors = rng.chisquare(2, 500)
    noise = rng.normal(0.0, 0.3, 500)
    noise -= noise.mean()
    assert within(1.0, errors, errors)
    assert within(1.0, errors + noise + 0.01, errors)
    assert not within(1.0, errors + noise + 0.02, errors)
    assert within(2.0, errors + noise + 0.02, errors)


def test_a_part_gained_is_of_the_errors_without_and_as_sure_as_they_are_many() -> None:
    errors = np.random.default_rng(0).chisquare(2, 400)
    part, deviation = part_gained(0.8 * errors, errors)
    assert part == pytest.approx(0.2, abs=0.01)
    assert part_gained(0.8 * errors[:100], errors[:100])[1] == pytest.approx(2.0 * deviation, rel=0.3)
    assert part_gained(1.2 * errors, errors)[0] < -0.1
    assert part_gained(errors, errors) == part_gained(errors[:0], errors[:0]) == (0.0, 0.0)
    assert part_gained(0.0 * errors, 0.0 * errors) == (0.0, 0.0)


def test_fits_go_on_from_those_before() -> None:
    """Under other lengths they end near those of many iterations, and the points left out stay the same."""
    measurements, shape, seen, _ = fitted(0.01, n_frames=12, n_points=100, pixels=1.0)
    tight = replace(measurements, length_weight=2.0 * measurements.length_weight)
    left_out = HeldOut(shape, seen)
    first, after = left_out.errors(measurements), left_out.errors(tight)
    assert first.shape == after.shape
    assert after.mean() == pytest.approx(left_out.errors(tight).mean(), rel=0.05)
    assert left_out.errors(measurements).mean() == pytest.approx(first.mean(), rel=0.05)


@pytest.mark.parametrize(
    ("predicted", "taken"),
    [
        ((-0.05, -0.1, 0.0, 0.2), 0.01),
        ((0.0, -0.1, 0.0, 0.2), 0.01 / 2),
        ((0.0, 0.0, -0.1, -0.1), 0.01 / 4),
        ((0.1, 0.2, 0.3, 0.4, 0.4, 0.3, 0.5, 0.5), 0.01 / 2**5),
        (tuple(0.1 * n for n in range(1, 9)), 0.01 / 2**8),
    ],
)
def test_the_least_length_noise_that_predicts_as_well_as_the_best_is_taken(
    monkeypatch: pytest.MonkeyPatch, predicted: tuple[float, ...], taken: float
) -> None:
    """`predicted`: how much better than at first, halving after halving. Two make a step, up to the first in vain; one
    is looked at between the last and what is refuted."""
    scene = isometric_bending(n_frames=6, n_points=60, seed=1)
    tracks = with_noise(scene.tracks, PIXELS, seed=1)
    errors = np.random.default_rng(0).chisquare(2, 500)
    better = (0.0, *predicted)

    class Canned(HeldOut):
        def errors(self, measurements: Measurements) -> np.ndarray:
            return np.asarray((1.0 - better[round(np.log2(0.01 * measurements.length_weight.max()))]) * errors)

    monkeypatch.setattr("connrsfm_graph.refine.settle.HeldOut", Canned)
    sigma = PIXELS / tracks.focal_length()
    settings = RefineConfig(uncertainty=False)
    found = refine(tracks.normalised(), tracks.visible, scene.log_depth, settings, sigma)
    assert found.evidence["length noise"] == pytest.approx(taken)


def test_fits_that_are_compared_have_forgotten_the_points_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thorough fits predict about the same. Of the tightest lengths fits of 100 and of 300 iterations do not agree
    either, and rounding decides: there those that are compared must not predict much too well, as what remembers does.
    """
    measurements, shape, seen, _ = fitted(0.01, n_frames=12, n_points=100, pixels=1.0)

    def errors() -> np.ndarray:
        """Mean, with lengths held more and more tightly, after a walk as in `trusting_lengths`."""
        left_out, weight = HeldOut(shape, seen), measurements.length_weight
        levels = (replace(measurements, length_weight=times * weight) for times in (1, 4, 1, 4, 16, 64))
        return np.array([left_out.errors(level).mean() for level in levels])[2:]

    ours = errors()
    for name, value in {"_ITERATIONS": 100, "_TOLERANCE": 1e-6}.items():
        monkeypatch.setattr(held_out, name, value)
    monkeypatch.setattr("connrsfm_graph.refine.solve._CLOSE_TOLERANCE", 0.01)
    thorough = errors()
    np.testing.assert_allclose(ours[:2], thorough[:2], rtol=0.08)
    ratio = ours[2:] / thorough[2:]
    assert (ratio > 0.8).all()
    assert (ratio < 1.5).all()


@pytest.mark.slow
def test_what_keeps_its_lengths_is_nearer_to_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Than with lengths trusted as at first."""
    errors = {}
    for least in (settle._LEAST, 1.0):
        monkeypatch.setattr(settle, "_LEAST", least)
        errors[least] = []
        for seed in range(2):
            scene = isometric_bending(n_frames=12, n_points=100, smooth=True, seed=seed)
            tracks = with_noise(scene.tracks, 1.0, seed=seed)
            flat, settings = np.zeros_like(scene.log_depth), RefineConfig(uncertainty=False)
            found = refine(tracks.normalised(), tracks.visible, flat, settings, 1.0 / tracks.focal_length())
            errors[least].append(evaluate(found.points, tracks.points).e3d_percent)
    ours, as_at_first = errors.values()
    assert np.exp(np.mean(np.log(ours) - np.log(as_at_first))) < 0.85


def test_exact_data_are_beyond_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    """They leave nothing that points left out could tell."""

    def never(*arguments: object, closely: bool) -> np.ndarray:
        raise AssertionError("points were left out")

    monkeypatch.setattr(held_out, "minimise", never)
    scene = isometric_bending(n_frames=6, n_points=60, seed=1)
    image, seen = scene.tracks.normalised(), scene.tracks.visible
    found = refine(image, seen, scene.log_depth, RefineConfig(uncertainty=False), 1e-6)
    assert found.evidence["length noise"] == RefineConfig().length_sigma
    noisy = with_noise(scene.tracks, PIXELS, seed=1)
    sigma = PIXELS / noisy.focal_length()
    with pytest.raises(AssertionError, match="points were left out"):
        refine(noisy.normalised(), seen, scene.log_depth, RefineConfig(uncertainty=False), sigma)
