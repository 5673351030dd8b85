"""The rasteriser puts things where they are, nearer ones in front."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.report.raster import Raster, View, turned

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
ORIGIN, DEEPER = np.zeros(3), np.array([0.0, 0.0, 1.0])
RED, BLUE = np.tile([1.0, 0.0, 0.0], (4, 1)), np.tile([0.0, 0.0, 1.0], (4, 1))


def test_a_square_covers_its_area() -> None:
    view = View(np.eye(3), 10.3, (40, 60))
    picture = Raster.of(view, ORIGIN, SQUARE, HALVES).coloured(RED)
    assert picture.shape == (60, 40, 4)
    assert picture[..., 3].sum() / 255 == pytest.approx(20.6**2, rel=0.1)
    rows, columns = np.nonzero(picture[..., 3] > 127)
    assert (rows.mean(), columns.mean()) == pytest.approx((29.5, 19.5), abs=0.3)
    assert (picture[30, 20, :3] > 0).tolist() == [True, False, False]


@pytest.mark.parametrize("far_first", [True, False])
def test_the_nearer_surface_is_seen(far_first: bool) -> None:
    view = View(np.eye(3), 10.0, (40, 40))
    near, far = SQUARE - DEEPER, SQUARE + DEEPER
    stack = [(far, RED), (near, BLUE)] if far_first else [(near, BLUE), (far, RED)]
    points, colours = (np.concatenate(parts) for parts in zip(*stack, strict=True))
    picture = Raster.of(view, ORIGIN, points, np.concatenate([HALVES, HALVES + 4])).coloured(colours)
    assert picture[20, 23, 2] > 100
    assert picture[20, 23, 0] == 0


def test_walking_right_shows_the_right_side_and_climbing_the_top() -> None:
    # A point nearer to the camera than the centre moves left for a viewer who walked right, and down for one who rose.
    near = np.array([0.0, 0.0, -1.0])
    assert (turned(30, 0) @ near)[0] < 0
    assert (turned(0, 30) @ near)[1] > 0
    R = turned(40, 20)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1)


def test_colours_run_smoothly_between_corners() -> None:
    view = View(np.eye(3), 20.0, (44, 44))
    colours = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]])
    row = Raster.of(view, ORIGIN, SQUARE, HALVES).coloured(colours)[15, 4:40, 0].astype(int)
    assert row[0] < 20
    assert row[-1] > 180
    assert np.abs(np.diff(row)).max() < 40


def test_nothing_to_draw_is_transparent() -> None:
    view = View(np.eye(3), 10.0, (8, 8))
    assert not Raster.of(view, ORIGIN, SQUARE, np.empty((0, 3), int)).coloured(RED).any()
    flat = np.zeros((4, 3))
    assert np.isfinite(Raster.of(view, ORIGIN, flat, HALVES).coloured(RED)).all()


def test_a_photo_lies_on_the_surface_the_right_way_round() -> None:
    photo = np.zeros((20, 40, 3), np.uint8)
    photo[:10, :20], photo[:10, 20:], photo[10:, :20], photo[10:, 20:] = (200, 0, 0), (0, 200, 0), (0, 0, 200), 200
    corners = np.array([[0, 0], [39, 0], [39, 19], [0, 19]])
    picture = Raster.of(View(np.eye(3), 10.0, (40, 40)), ORIGIN, SQUARE, HALVES).textured(corners, photo)
    seen = picture[[14, 14, 26, 26], [14, 26, 14, 26], :3] > 100
    assert seen.tolist() == [[True, False, False], [False, True, False], [False, False, True], [True, True, True]]
    assert (picture[20, 11:18, 3] == 255).all()
