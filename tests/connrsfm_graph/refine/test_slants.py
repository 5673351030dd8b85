"""Slants that the data leave open: seen frontally where that predicts points left out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, Refined, refine, slant
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.planes import from_planes
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Fit, Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, moebius

SIGMA = 0.0015
"""Noise of the image points, normalised coordinates."""


def at_rest(n_frames: int, n_points: int, seed: int) -> np.ndarray:
    """(F, P, 3) a sheet that bends a little before a camera at rest."""
    points = isometric_bending(n_frames, n_points, bend=0.2, at_rest=True, seed=seed).tracks.points
    assert points is not None
    return points


def refined(points: np.ndarray, sigma: float, patches: tuple[int, ...] | None = None) -> Refined:
    """Refinement from flat views; `patches` other than those of the default."""
    image = points[..., :2] / points[..., 2:]
    image = image + np.random.default_rng(0).normal(0.0, sigma, image.shape)
    settings = RefineConfig()
    if patches is not None:
        settings = RefineConfig(uncertainty=False, frontal_patches=patches)
    return refine(image, np.ones(points.shape[:2], dtype=bool), np.zeros_like(points[..., 2]), settings, sigma)


def never(*arguments: object) -> np.ndarray:
    raise AssertionError("slants were compared")


@pytest.mark.parametrize(
    ("gains", "taken"),
    [
        ({30: 0.2, 100: 0.3}, 100),
        ({30: 0.2, 100: 0.1}, 30),
        ({30: 0.0, 100: 0.0}, 0),
        ({30: -0.1, 100: 0.1}, 100),
        ({30: -0.1, 100: -0.1}, 0),
    ],
)
def test_the_prior_that_predicts_points_left_out_best_is_taken(
    monkeypatch: pytest.MonkeyPatch, gains: dict[int, float], taken: int
) -> None:
    errors = np.random.default_rng(0).chisquare(2, 500)

    def canned(fits: Iterable[Fit], seen: np.ndarray) -> list[np.ndarray]:
        return [(1.0 - {0: 0.0, **gains}[fit.noise.patches]) * errors for fit in fits]

    monkeypatch.setattr("connrsfm_graph.refine.slant.errors_of", canned)
    assert refined(at_rest(5, 30, 0), SIGMA).evidence["patches assumed frontal"] == taken


def test_flattened_surfaces_have_less_relief_and_lengths_to_match() -> None:
    points = at_rest(5, 30, 0)
    image, seen = points[..., :2] / points[..., 2:], np.ones(points.shape[:2], dtype=bool)
    task = Task.of(complete(image, seen, np.log(points[..., 2])), seen, RefineConfig())
    noise = Noise.start(SIGMA, 0.01, task.spacing())
    found = Fit(task.measurements(noise, conformal=False), start_shape(task.completed, task.mesh), noise, [], 0.0)
    flat = slant._flattened(found)
    relief = np.ptp(found.shape.log_depth, axis=1)
    np.testing.assert_allclose(np.ptp(flat.shape.log_depth, axis=1), 0.25 * relief)
    assert flat.shape.log_length.mean() == pytest.approx(0.0, abs=1e-12)
    assert np.median(flat.residuals(), axis=0) == pytest.approx(np.zeros(len(task.mesh.edges)), abs=1e-12)


def test_inclined_views_are_planes() -> None:
    points = at_rest(5, 30, 0)
    image, seen = points[..., :2] / points[..., 2:], np.ones(points.shape[:2], dtype=bool)
    task = Task.of(complete(image, seen, np.log(points[..., 2])), seen, RefineConfig())
    slope = np.array([0.5, -0.2])
    depth = np.exp(task.inclined(slope).completed.log_depth)
    for view, d in zip(image, depth, strict=True):
        plane = np.linalg.lstsq(np.column_stack([d[:, None] * view, d]), np.ones(len(d)), rcond=None)[0]
        np.testing.assert_allclose(d * (view @ plane[:2] + plane[2]), 1.0, atol=1e-12)
        np.testing.assert_allclose(plane[:2] / (plane[2] + view.mean(axis=0) @ plane[:2]), -slope, atol=1e-12)


def test_planes_that_lean_the_right_way_become_the_cheapest_surfaces() -> None:
    """And keep the strains of views that are stretched."""
    points = isometric_bending(8, 80, bend=0.8, at_rest=True, seed=1).tracks.points
    assert points is not None
    middle = points.mean(axis=(0, 1))
    turn = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    points = (points - middle) @ turn.T + middle
    image, seen = points[..., :2] / points[..., 2:], np.ones(points.shape[:2], dtype=bool)
    task = Task.of(complete(image, seen, np.zeros_like(points[..., 2])), seen, RefineConfig())
    noise = Noise.start(SIGMA, 0.01, task.spacing())
    flat = start_shape(task.completed, task.mesh)
    found = Fit(task.measurements(noise, conformal=False), flat, noise, [], 0.0)
    fits = [fit for _, fit in from_planes(task, lambda plane: slant._from_plane(task, found, noise, plane))]
    assert fits[0].history[-1] <= fits[1].history[-1]
    errors = [evaluate(shape.points(image), points).e3d_percent for shape in (fits[0].shape, flat)]
    assert errors[0] < 0.5 * errors[1]
    stretched = replace(found, shape=replace(flat, strain=np.zeros((8, 2))))
    assert slant._from_plane(task, stretched, noise, task.flat()).shape.strain.shape == (8, 2)


def test_exact_data_and_no_patches_leave_nothing_to_assume(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("connrsfm_graph.refine.slant.errors_of", never)
    points = at_rest(5, 30, 0)
    assert refined(points, 1e-7).evidence["patches assumed frontal"] == 0
    assert refined(points, SIGMA, ()).evidence["patches assumed frontal"] == 0
    with pytest.raises(AssertionError, match="slants were compared"):
        refined(points, SIGMA)


def test_slants_that_tracks_hold_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    points = isometric_bending(8, 60, seed=0).tracks.points
    assert points is not None
    monkeypatch.setattr("connrsfm_graph.refine.slant.errors_of", never)
    found = refined(points, 0.1 * SIGMA)
    assert 0.0 < found.evidence["part of the relief that frontal patches move"] < 0.01
    with pytest.raises(AssertionError, match="slants were compared"):
        refined(points, 10.0 * SIGMA)


def test_what_is_taken_for_conformal_has_no_slants_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("connrsfm_graph.refine.slant.errors_of", never)
    points = moebius(5, 60).tracks.points
    assert points is not None
    found = refined(points, 1e-6)
    assert found.evidence["isometric misfit"] > 1.0
    assert found.model == "conformal"


@pytest.mark.slow
def test_slants_that_the_data_leave_open_are_nearer_to_the_truth() -> None:
    """And stated to be as open as they are."""
    scenes = [at_rest(8, 100, seed) for seed in range(2)]
    with_it, without = ([refined(points, SIGMA, patches) for points in scenes] for patches in (None, ()))
    ratios = []
    for points, found, other in zip(scenes, with_it, without, strict=True):
        errors = [evaluate(each.points, points).e3d_percent for each in (found, other)]
        ratios.append(np.log(errors[0] / errors[1]))
        error = found.log_depth - np.log(points[..., 2])
        normalised = (error - np.median(error)) / (found.depth_std / np.exp(found.log_depth))
        assert 0.1 < (normalised**2).mean() < 2.0
    assert np.exp(np.mean(ratios)) < 0.8
