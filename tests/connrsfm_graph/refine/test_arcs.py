"""Arcs over the mesh's edges, of surfaces as they are and smoothed."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, fit, refine, settle
from connrsfm_graph.refine.arcs import ArcSplines, arc_offset_kernel
from connrsfm_graph.refine.measurements import Measurements, lag
from connrsfm_graph.refine.mesh import Mesh, surface_mesh
from connrsfm_graph.refine.restarts import restart
from connrsfm_graph.refine.solve import fit_views, minimise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Fit, Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, with_noise
from connrsfm_graph.tracks.tracks import Tracks

RADIUS = 1.0


def ball(noise: float = 0.0, n_points: int = 150) -> tuple[np.ndarray, np.ndarray, Mesh]:
    """Image points (1, P, 2) and log depths (1, P) of a piece of a sphere, and its mesh."""
    rng = np.random.default_rng(0)
    image = rng.uniform(-0.3, 0.3, (1, n_points, 2))
    square = (image**2).sum(axis=-1)
    # The nearer of the two places where a ray meets the sphere about (0, 0, 1 + RADIUS).
    centre = 1.0 + RADIUS
    depth = (centre - np.sqrt(centre**2 - (1.0 + square) * (centre**2 - RADIUS**2))) / (1.0 + square)
    log_depth = np.log(depth) + rng.normal(0.0, noise, depth.shape)
    return image, log_depth, surface_mesh(image[0], lambda edges: np.zeros(len(edges)), 2)


def offsets(image: np.ndarray, log_depth: np.ndarray, mesh: Mesh, splines: ArcSplines) -> np.ndarray:
    depth = np.exp(log_depth)[..., None]
    points = np.concatenate([depth * image, depth], axis=-1)
    offset = np.full((len(points), len(mesh.edges)), np.nan)
    arc_offset_kernel(0, len(points), points, mesh.triangles, mesh.edges, splines, offset)
    return offset


def true_offsets(image: np.ndarray, log_depth: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Of great circles."""
    depth = np.exp(log_depth)[..., None]
    points = np.concatenate([depth * image, depth], axis=-1)
    half = 0.5 * np.linalg.norm(points[:, mesh.edges[:, 0]] - points[:, mesh.edges[:, 1]], axis=-1) / RADIUS
    return np.log(np.arcsin(half) / half)


@pytest.mark.parametrize(("smoothed", "missed"), [(False, 0.1), (True, 0.3)])
def test_arcs_of_a_sphere(smoothed: bool, missed: float) -> None:
    image, log_depth, mesh = ball()
    splines = ArcSplines.over(image) if smoothed else ArcSplines.none(1)
    truth = true_offsets(image, log_depth, mesh)
    error = offsets(image, log_depth, mesh, splines) - truth
    assert np.sqrt((error**2).mean()) < missed * np.sqrt((truth**2).mean())


def test_noise_of_depths_is_not_taken_for_curvature() -> None:
    image, log_depth, mesh = ball()
    truth = true_offsets(image, log_depth, mesh)
    _, noisy, _ = ball(0.005)
    rough, smooth = (
        np.sqrt(((offsets(image, noisy, mesh, splines) - truth) ** 2).mean())
        for splines in (ArcSplines.none(1), ArcSplines.over(image))
    )
    assert smooth < 0.15 * rough
    assert smooth < 0.5 * np.sqrt((truth**2).mean())


def test_a_plane_has_no_arcs_however_it_leans() -> None:
    image, _, mesh = ball()
    for slope in ((0.0, 0.0), (0.8, -0.5)):
        log_depth = -np.log(1.0 - image @ np.array(slope))
        assert np.abs(offsets(image, log_depth, mesh, ArcSplines.over(image))).max() < 2e-4


def test_waves_of_a_third_of_the_image_are_halved_and_longer_ones_stay() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0.0, 1.0, (1, 300, 2))
    columns, rows, smoothing = (part[0] for part in ArcSplines.over(image))
    inside = (np.abs(image[0] - 0.5) < 0.3).all(axis=1)
    for length, least, most in ((0.33, 0.3, 0.6), (0.8, 0.9, 1.05), (0.15, 0.0, 0.15)):
        wave = np.sin(2.0 * np.pi * image[0, :, 0] / length)
        right = np.zeros(len(smoothing))
        np.add.at(right, columns, rows[:, 0] * wave[:, None])
        smooth = (rows[:, 0] * (smoothing @ right)[columns]).sum(axis=1)
        left = (smooth @ (wave * inside)) / (wave @ (wave * inside))
        assert least < left < most


def test_points_at_one_place_are_no_trouble() -> None:
    image, log_depth, mesh = ball(n_points=40)
    image[:, 1], log_depth[:, 1] = image[:, 0], log_depth[:, 0]
    assert np.isfinite(offsets(image, log_depth, mesh, ArcSplines.over(image))).all()


def noisy_sheet(pixels: float = 2.0, seed: int = 1) -> tuple[Tracks, Task, Fit]:
    tracks = with_noise(isometric_bending(8, 80, seed=seed).tracks, pixels, seed)
    depth = isometric_bending(8, 80, seed=seed).log_depth
    task = Task.of(complete(tracks.normalised(), tracks.visible, depth), tracks.visible, RefineConfig())
    return tracks, task, fit.fit_isometric(task, fit.Noise.start(pixels / 600, 0.01, task.spacing()))


def test_one_by_one_and_jointly_views_have_the_same_arcs() -> None:
    _, task, found = noisy_sheet()
    task = task.smoothed(found.shape)
    measurements = task.measurements(found.noise, conformal=False)
    assert measurements.arcs is not None
    shape, cost = fit_views(measurements, found.shape, 0, 0.0)
    view = np.array([3])
    _, alone = fit_views(measurements.views(view), shape.views(view), 0, 0.0)
    np.testing.assert_array_equal(alone, cost[view])
    jointly, history = minimise(measurements, found.shape, 60, 1e-6)
    _, each = fit_views(measurements, jointly, 30, 1e-9)
    assert each.sum() == pytest.approx(history[-1], rel=0.01)
    back = measurements.replaced(view, measurements.views(view))
    np.testing.assert_array_equal(lag(back, shape).offset, lag(measurements, shape).offset)
    flat = start_shape(task.flat().completed, task.mesh)
    again, renewed = restart(measurements.views(view), shape.replaced(view, flat.views(view)).views(view))
    assert renewed.all()
    assert np.isfinite(again.log_depth).all()


@pytest.mark.parametrize("refuted", [False, True])
def test_points_left_out_may_refute_it(refuted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    _, task, found = noisy_sheet()
    errors = np.random.default_rng(0).chisquare(2, 500)

    def predicted(self: settle.HeldOut, measurements: Measurements) -> np.ndarray:
        return errors * (1.1 if refuted and measurements.arcs is not None else 1.0)

    monkeypatch.setattr(settle.HeldOut, "errors", predicted)
    assert found.noisy
    smooth, again = settle.over_smooth_arcs(task, found)
    if refuted:
        assert smooth is task
        assert again is found
    else:
        assert smooth.arcs is again.measurements.arcs is not None


def refined_error(tracks: Tracks, pixels: float) -> tuple[float, bool]:
    start = np.zeros(tracks.visible.shape)
    refined = refine(tracks.normalised(), tracks.visible, start, RefineConfig(), pixels / tracks.focal_length())
    assert tracks.points is not None
    smooth = refined.evidence["arcs over smoothed surfaces"]
    return evaluate(refined.points, tracks.points, tracks.visible).e3d_percent, bool(smooth)


@pytest.mark.slow
def test_noisy_sheets_are_nearer_to_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = []
    for seed in range(3):
        tracks, _, _ = noisy_sheet(seed=seed)
        smooth = refined_error(tracks, 2.0)
        with monkeypatch.context() as patch:
            patch.setattr(fit, "over_smooth_arcs", lambda task, found: (task, found))
            rough = refined_error(tracks, 2.0)
        assert (smooth[1], rough[1]) == (True, False)
        errors.append((smooth[0], rough[0]))
    smooth_error, rough_error = np.exp(np.log(errors).mean(axis=0))
    assert smooth_error < 0.95 * rough_error


def test_exact_sheets_are_left_as_they_are() -> None:
    error, smooth = refined_error(isometric_bending(6, 60).tracks, 0.1)
    assert not smooth
    assert error < 0.1
