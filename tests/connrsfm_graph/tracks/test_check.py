"""Input that no reconstruction can use is named; input that one can live with is mended and told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks import Tracks, load_tracks
from connrsfm_graph.tracks.check import check_reconstructable

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def views(frames: int = 6, points: int = 40, seed: int = 0) -> np.ndarray:
    """Images of a bent sheet that turns in the image plane and is seen at different tilts."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-1, 1, (points, 2))
    images = []
    for _ in range(frames):
        turn, tilt, bend = rng.uniform(-3, 3), rng.uniform(0.4, 1.0), rng.uniform(-0.4, 0.4)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        images.append(200 * (flat + bend * flat[:, ::-1] ** 2) @ np.diag([tilt, 1.0]) @ rotation + [320, 240])
    return np.array(images)


def check(pixels: np.ndarray, visible: np.ndarray | None = None) -> tuple[Tracks, tuple[str, ...]]:
    return check_reconstructable(Tracks.checked(pixels, K, visible), "a.npz")


@given(st.integers(3, 12), st.integers(8, 60), st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_good_tracks_pass_unchanged(frames: int, points: int, seed: int) -> None:
    pixels = views(frames, points, seed)
    tracks, warnings = check(pixels)
    assert warnings == ()
    np.testing.assert_array_equal(tracks.pixels, pixels)


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["tshirt", "flag", "kinect_paper"])
def test_real_tracks_pass(realdata, name: str) -> None:
    _, warnings = check_reconstructable(load_tracks(realdata(f"{name}.npz")))
    assert warnings == ()


@pytest.mark.parametrize("where", [1e12, -1e307])
def test_a_wild_observation_is_left_out(where: float) -> None:
    """It would make all others a point, and the image a line."""
    pixels = views()
    pixels[2, 7] = [where, 10.0]
    tracks, warnings = check(pixels)
    assert not tracks.visible[2, 7]
    assert tracks.visible.sum() == tracks.visible.size - 1
    (warning,) = warnings
    assert warning.startswith(
        "1 observations lie far outside the others of their image (the first is point 7 of image 2"
    )


@pytest.mark.parametrize("factor", [1e300, 1e9, 1e-8])
def test_intrinsics_of_another_world_are_refused(factor: float) -> None:
    with pytest.raises(InputError, match=r"focal lengths.*do the intrinsics belong to these pixels"):
        check_reconstructable(Tracks.checked(views(), K * [[factor], [factor], [1.0]]))


def test_pixels_far_off_the_axis_are_refused() -> None:
    with pytest.raises(InputError, match=r"2e\+05 off the camera's axis.*do the intrinsics belong to these pixels"):
        check(views() + 1e8)


def test_images_are_called_by_their_names() -> None:
    pixels = views()
    pixels[3, :, 1] = 5.0
    tracks = Tracks.checked(pixels, K, image_names=[f"frame {10 * n}" for n in range(6)])
    with pytest.raises(InputError, match="all points of frame 30 lie on one line"):
        check_reconstructable(tracks)


def test_too_few_images_and_points() -> None:
    with pytest.raises(InputError, match=r"a\.npz: shows 2 images, expected at least 3 because"):
        check(views(2))
    with pytest.raises(InputError, match=r"holds 3 points, expected at least 6"):
        check(views(5, 3))


def test_empty_and_poor_images_are_named() -> None:
    visible = np.ones((6, 40), dtype=bool)
    visible[4] = False
    with pytest.raises(InputError, match=r"image 4 shows no point"):
        check(views(), visible)
    visible[4, :5] = True
    with pytest.raises(InputError, match=r"image 4 shows 5 points"):
        check(views(), visible)
    visible[[2, 5]] = False
    with pytest.raises(InputError, match=r"image 2 \(and 1 other\) shows no point"):
        check(views(), visible)


def test_points_on_a_line() -> None:
    pixels = views()
    pixels[3, :, 1] = 2 * pixels[3, :, 0] + 5
    with pytest.raises(InputError, match="all points of image 3 lie on one line"):
        check(pixels)


@pytest.mark.parametrize("frames", [3, 4, 30])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_image_is_named(frames: int, axis: int) -> None:
    pixels = views(frames)
    pixels[1, :, axis] = 640 - pixels[1, :, axis]
    with pytest.raises(InputError, match="image 1 shows the points mirrored"):
        check(pixels)


def test_duplicate_tracks_are_hidden_and_told() -> None:
    pixels = views()
    pixels[:, 7] = pixels[:, 3]
    pixels[2, 30] = pixels[2, 3]
    tracks, warnings = check(pixels)
    assert len(warnings) == 1
    assert "2 points lie at the same pixel" in warnings[0]
    assert "(point 7 as point 3, in 6 images)" in warnings[0]
    assert not tracks.visible[:, 7].any()
    assert np.isnan(tracks.pixels[:, 7]).all()
    assert tracks.visible[:, 3].all()
    assert np.flatnonzero(~tracks.visible[:, 30]).tolist() == [2]
    assert tracks.n_points == 40


def test_duplicates_do_not_count_as_points() -> None:
    pixels = views(points=8)
    pixels[:, 4:] = pixels[:, 3:4]
    with pytest.raises(InputError, match=r"image 0 .*shows 4 points"):
        check(pixels)


def test_rarely_seen_points_are_told() -> None:
    visible = np.ones((6, 40), dtype=bool)
    visible[1:, 11] = False
    visible[:, 12] = False
    _, warnings = check(views(), visible)
    assert "2 points are seen in fewer than two images (the first is point 11)" in warnings[0]
    pixels = views(3, 30)
    with pytest.raises(InputError, match="no point is seen in two images"):
        check(pixels, np.repeat(np.eye(3, dtype=bool), 10, axis=1))


def test_pixels_that_do_not_fit_the_camera_are_told() -> None:
    normalised = (views() - [320, 240]) / 500
    _, warnings = check_reconstructable(Tracks.checked(normalised, np.eye(3)))
    assert "normalised coordinates" in warnings[0]
    _, warnings = check_reconstructable(Tracks.checked(views() * 30, K))
    assert "degrees off" in warnings[0]


@pytest.mark.parametrize("shift", [0.0, 10.0])
def test_images_that_do_not_differ_are_refused(shift: float) -> None:
    frame = np.random.default_rng(0).uniform(100, 500, size=(30, 2))
    pixels = frame + shift * np.arange(4)[:, None, None]
    with pytest.raises(InputError, match="differ by no more than a shift"):
        check_reconstructable(Tracks.checked(pixels, np.diag([500.0, 500.0, 1.0])))
