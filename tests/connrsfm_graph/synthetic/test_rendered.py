"""The rendered sheet: images, depth and sheet coordinates belong together, and paper does not stretch."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.synthetic.rendered import SHEET, RenderConfig, RenderedSequence, render_sequence
from connrsfm_graph.tracks import Tracks, check_reconstructable
from connrsfm_graph.tracks.draw import draw_tracks

SMALL = RenderConfig(frames=5, width=320, height=240, focal=310)


@pytest.fixture(scope="module")
def sequence() -> RenderedSequence:
    return render_sequence(SMALL)


def exact_tracks(sequence: RenderedSequence, across: int = 12, down: int = 9) -> tuple[Tracks, np.ndarray]:
    """Projections of a grid on the sheet, and the grid's sheet coordinates."""
    a, b = (0.98 * side * np.linspace(-0.5, 0.5, n) for side, n in zip(SHEET, (across, down), strict=True))
    grid = np.stack(np.meshgrid(a, b), axis=-1).reshape(-1, 2)
    points = np.stack([surface.surface(grid)[0] for surface in sequence.surfaces])
    image = points @ sequence.K.T
    return Tracks.checked(image[..., :2] / image[..., 2:], sequence.K), grid


def test_shapes_and_contrast(sequence: RenderedSequence) -> None:
    assert sequence.images.shape == (5, 240, 320, 3)
    assert sequence.depth.shape == sequence.sheet.shape[:3] == (5, 240, 320)
    assert (np.isfinite(sequence.depth).mean(axis=(1, 2)) > 0.3).all()
    assert (sequence.images.std(axis=(1, 2)) > 20).all()


def test_every_pixel_shows_the_point_its_depth_and_sheet_coordinates_say(sequence: RenderedSequence) -> None:
    for surface, depth, sheet in zip(sequence.surfaces, sequence.depth, sequence.sheet, strict=True):
        y, x = np.nonzero(np.isfinite(depth))
        point = surface.surface(sheet[y, x])[0]
        np.testing.assert_allclose(point[:, 2], depth[y, x], atol=1e-9)
        pixel = point @ sequence.K.T
        np.testing.assert_allclose(pixel[:, :2] / pixel[:, 2:], np.column_stack([x, y]), atol=1e-5)


def test_sheet_does_not_stretch_but_bends(sequence: RenderedSequence) -> None:
    grid = np.random.default_rng(0).uniform(-0.35, 0.35, (200, 2))
    bends = []
    for surface in sequence.surfaces:
        _, by_a, by_b = surface.surface(grid)
        metric = np.stack([(by_a**2).sum(-1), (by_a * by_b).sum(-1), (by_b**2).sum(-1)])
        np.testing.assert_allclose(metric, np.array([1, 0, 1])[:, None] * np.ones(200), atol=1e-6)
        normal = np.cross(by_a, by_b)
        bends.append(np.degrees(np.arccos(np.clip(normal @ normal.T, -1, 1).min())))
    assert min(bends) > 5
    assert max(bends) > 40


def test_derivatives_of_the_surface() -> None:
    surface = render_sequence(RenderConfig(frames=2, width=64, height=48, focal=62)).surfaces[1]
    grid = np.random.default_rng(1).uniform(-0.35, 0.35, (50, 2))
    _, by_a, by_b = surface.surface(grid)
    h = 1e-5
    for k, by in enumerate((by_a, by_b)):
        step = h * np.eye(2)[k]
        difference = (surface.surface(grid + step)[0] - surface.surface(grid - step)[0]) / (2 * h)
        np.testing.assert_allclose(by, difference, atol=1e-8)


def test_truth_of_exact_tracks(sequence: RenderedSequence) -> None:
    tracks, grid = exact_tracks(sequence)
    tracks.pixels[1, 5] = np.nan
    tracks.visible[1, 5] = False
    truth = sequence.truth_for(tracks)
    ab = sequence.sheet_at(tracks)
    assert truth.points is not None
    assert truth.normals is not None
    assert np.isnan(truth.points[1, 5]).all()
    known = np.isfinite(ab[..., 0])
    assert known.mean() > 0.95
    np.testing.assert_allclose(ab[known], np.broadcast_to(grid, ab.shape)[known], atol=1e-9)
    expected = np.stack([surface.surface(grid)[0] for surface in sequence.surfaces])
    np.testing.assert_allclose(truth.points[known], expected[known], atol=1e-9)
    assert (np.sum(truth.normals[known] * truth.points[known], axis=-1) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(truth.normals[known], axis=-1), 1.0)


def test_background_and_outside_have_no_truth(sequence: RenderedSequence) -> None:
    pixels = np.tile([[1.0, 1.0], [-50.0, 1e5]], (5, 1, 1))
    truth = sequence.truth_for(Tracks.checked(pixels, sequence.K))
    assert truth.points is not None
    assert np.isnan(truth.points).all()


def test_tracks_of_the_sheet_are_fit_for_reconstruction(sequence: RenderedSequence) -> None:
    assert check_reconstructable(exact_tracks(sequence)[0])[1] == ()


def test_same_seed_same_images_other_seed_other_print() -> None:
    config = RenderConfig(frames=2, width=64, height=48, focal=62)
    np.testing.assert_array_equal(render_sequence(config).images, render_sequence(config).images)
    other = render_sequence(RenderConfig(frames=2, width=64, height=48, focal=62, seed=1))
    assert (other.images != render_sequence(config).images).mean() > 0.2
    np.testing.assert_array_equal(other.depth, render_sequence(config).depth)


def test_unbent_sheet_is_a_plane() -> None:
    sequence = render_sequence(RenderConfig(frames=2, width=64, height=48, focal=62, bend=0.0))
    for depth in sequence.depth:
        y, x = np.nonzero(np.isfinite(depth))
        design = np.column_stack([x, y, np.ones(len(x))])
        inverse = 1 / depth[y, x]
        np.testing.assert_allclose(design @ np.linalg.lstsq(design, inverse, rcond=None)[0], inverse, atol=1e-7)


def test_drawn_tracks_stay_at_their_points(sequence: RenderedSequence) -> None:
    tracks, _ = exact_tracks(sequence)
    before = sequence.images[3].copy()
    picture = draw_tracks(sequence.images[3], tracks, 3, tail=0)
    np.testing.assert_array_equal(sequence.images[3], before)
    changed = (picture != before).any(axis=-1)
    y, x = np.nonzero(changed)
    nearest = np.linalg.norm(np.column_stack([x, y])[:, None] - tracks.pixels[3], axis=-1)
    assert nearest.min(axis=1).max() < 6
    assert nearest.min(axis=0).max() < 3
