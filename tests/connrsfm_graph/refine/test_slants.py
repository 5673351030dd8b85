"""Slants that the data leave open: seen frontally where points left out allow it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.refine.solve import Measurements

SIGMA = 0.002
"""Noise of the image points, normalised coordinates."""


def at_rest(n_frames: int, n_points: int, seed: int) -> np.ndarray:
    """(F, P, 3) a sheet of size 2 x 2 that bends a little before a camera at rest."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-1.0, 1.0, (2, n_points))
    turn = Rotation.from_euler("xyz", rng.uniform(-10.0, 10.0, 3), degrees=True).as_matrix()
    views = []
    for bend, saddle in rng.uniform(-0.1, 0.1, (n_frames, 2)):
        sheet = np.stack([u, v, bend * np.sin(2.0 * u) + saddle * u * v], axis=-1)
        views.append(sheet @ turn.T + [0.0, 0.0, 4.0])
    return np.array(views)


def refined(points: np.ndarray, sigma: float, patches: tuple[int, ...] | None = None) -> Refined:
    """Refinement from flat views; `patches` other than those of the default."""
    image = points[..., :2] / points[..., 2:]
    image = image + np.random.default_rng(0).normal(0.0, sigma, image.shape)
    settings = RefineConfig(uncertainty=False)
    if patches is not None:
        settings = RefineConfig(uncertainty=False, frontal_patches=patches)
    return refine(image, np.ones(points.shape[:2], dtype=bool), np.zeros_like(points[..., 2]), settings, sigma)


@pytest.mark.parametrize(
    ("gains", "taken"),
    [
        ({30: 0.2, 100: 0.3}, 100),
        ({30: 0.2, 100: 0.1}, 30),
        ({30: 0.0, 100: 0.0}, 100),
        ({30: 0.0, 100: -0.1}, 30),
        ({30: -0.1, 100: 0.1}, 100),
        ({30: -0.1, 100: -0.1}, 0),
    ],
)
def test_the_strongest_prior_that_predicts_as_well_as_the_best_is_taken(
    monkeypatch: pytest.MonkeyPatch, gains: dict[int, float], taken: int
) -> None:
    errors = np.random.default_rng(0).chisquare(2, 500)

    def canned(measurements: Measurements, *arguments: object) -> np.ndarray:
        patches = round(measurements.weights.frontal * len(measurements.mesh.edges) / 8.0)
        return np.asarray((1.0 - {0: 0.0, **gains}[patches]) * errors)

    monkeypatch.setattr("connrsfm_graph.refine.slant.prediction_errors", canned)
    assert refined(at_rest(5, 30, 0), SIGMA).evidence["patches assumed frontal"] == taken


@pytest.mark.parametrize(("worse_by", "taken"), [(0.5, 100), (2.0, 0)])
def test_worse_by_chance_is_not_worse(monkeypatch: pytest.MonkeyPatch, worse_by: float, taken: int) -> None:
    """By so many standard errors of the difference."""
    rng = np.random.default_rng(0)
    errors, chance = rng.uniform(1.0, 2.0, 500), rng.normal(0.0, 0.1, 500)
    chance += worse_by * chance.std() / np.sqrt(len(chance)) - chance.mean()

    def canned(measurements: Measurements, *arguments: object) -> np.ndarray:
        return np.asarray(errors + chance if measurements.weights.frontal > 0.0 else errors)

    monkeypatch.setattr("connrsfm_graph.refine.slant.prediction_errors", canned)
    assert refined(at_rest(5, 30, 0), SIGMA).evidence["patches assumed frontal"] == taken


def test_exact_data_and_no_patches_leave_nothing_to_assume(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*arguments: object) -> np.ndarray:
        raise AssertionError("slants were compared")

    monkeypatch.setattr("connrsfm_graph.refine.slant.prediction_errors", never)
    points = at_rest(5, 30, 0)
    assert refined(points, 1e-7).evidence["patches assumed frontal"] == 0
    assert refined(points, SIGMA, ()).evidence["patches assumed frontal"] == 0
    with pytest.raises(AssertionError, match="slants were compared"):
        refined(points, SIGMA)


@pytest.mark.slow
def test_slants_that_the_data_leave_open_are_nearer_to_the_truth() -> None:
    scenes = [at_rest(10, 60, seed) for seed in range(6)]
    with_it, without = (
        [evaluate(refined(points, SIGMA, patches).points, points).e3d_percent for points in scenes]
        for patches in (None, ())
    )
    assert np.exp(np.mean(np.log(with_it) - np.log(without))) < 0.85
