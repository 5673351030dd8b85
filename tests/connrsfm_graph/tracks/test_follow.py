"""Tracks follow the surface, not the image's noise; what cannot be followed is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.rendered import RenderConfig, RenderedSequence, render_sequence
from connrsfm_graph.tracks import Tracks, check_reconstructable, parse_intrinsics
from connrsfm_graph.tracks.config import TrackingConfig
from connrsfm_graph.tracks.corners import corners, not_black
from connrsfm_graph.tracks.follow import track_images
from connrsfm_graph.tracks.neighbours import local_affinity
from connrsfm_graph.tracks.register import patches, register

K = np.array([[310.0, 0, 160], [0, 310, 120], [0, 0, 1]])


def texture(height: int = 240, width: int = 320, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 5 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


def write_all(folder: Path, images: list[np.ndarray] | np.ndarray) -> Path:
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k:03d}.png"), image if image.ndim == 2 else image[..., ::-1])
    return folder


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[RenderedSequence, Path]:
    sequence = render_sequence(RenderConfig(frames=12, width=480, height=360, focal=465))
    return sequence, write_all(tmp_path_factory.mktemp("rendered") / "images", sequence.images)


def drift(sequence: RenderedSequence, tracks: Tracks) -> np.ndarray:
    """Movement on the sheet since first seen, in pixels of a frontal view; NaN where unknown."""
    ab = sequence.sheet_at(tracks)
    first = ab[tracks.visible.argmax(axis=0), np.arange(tracks.n_points)]
    return np.linalg.norm(ab - first, axis=-1) * sequence.K[0, 0] / 1.3


def test_tracks_stay_at_their_points_of_a_bending_sheet(rendered: tuple[RenderedSequence, Path]) -> None:
    sequence, folder = rendered
    done: list[tuple[int, int]] = []
    tracks = track_images(folder, sequence.K, progress=lambda *step: done.append(step))
    assert done == [(k, 12) for k in range(1, 13)]
    assert tracks.image_names == tuple(f"{k:03d}.png" for k in range(12))
    assert tracks.visible.all(axis=0).sum() >= 200
    error = drift(sequence, tracks)
    assert np.nanmedian(error[-1]) < 0.06
    assert np.nanpercentile(error, 95) < 0.25
    beside = np.isnan(error) & tracks.visible
    assert beside.mean() < 0.025  # corners on the very border of the sheet
    assert check_reconstructable(tracks)[1] == ()


def sheet_places(sequence: RenderedSequence, tracks: Tracks, frames: list[int]) -> np.ndarray:
    """(F, P, 2) as `sheet_at`, for tracks of some frames in any order."""
    part = replace(sequence, sheet=sequence.sheet[frames], surfaces=tuple(sequence.surfaces[f] for f in frames))
    return part.sheet_at(tracks)


def test_points_that_were_covered_are_found_again(rendered: tuple[RenderedSequence, Path], tmp_path: Path) -> None:
    sequence, _ = rendered
    covered = sequence.images.copy()
    covered[4:8, :, 150:260] = (40 + 20 * (np.arange(110) // 10 % 2))[:, None]
    folder = write_all(tmp_path / "covered", covered)
    with_gap = {}
    for rejoin in (0, 5):
        tracks = track_images(folder, sequence.K, TrackingConfig(rejoin=rejoin))
        both = tracks.visible[0] & tracks.visible[-1] & ~tracks.visible.all(axis=0)
        with_gap[rejoin] = both.sum()
        ab = sheet_places(sequence, tracks, list(range(12)))
        away = np.linalg.norm(ab[-1] - ab[0], axis=-1)[both] * sequence.K[0, 0] / 1.3
        if rejoin:
            assert np.nanmedian(away) < 0.1
            assert np.nanpercentile(away, 95) < 0.5
    assert with_gap[0] == 0
    assert with_gap[5] > 100


def test_images_in_any_order_are_joined_by_matches(rendered: tuple[RenderedSequence, Path], tmp_path: Path) -> None:
    sequence, _ = rendered
    order = [0, 11, 5, 2, 8, 3, 10, 6]
    folder = write_all(tmp_path / "jumps", sequence.images[order])
    tracks = track_images(folder, sequence.K)
    assert tracks.visible.sum(axis=1).min() > 300
    assert (tracks.visible[0] & tracks.visible[-1]).sum() > 200
    ab = sheet_places(sequence, tracks, order)
    ab = ab[:, np.isfinite(ab).any(axis=(0, 2))]
    away = np.linalg.norm(ab - np.nanmedian(ab, axis=0), axis=-1) * sequence.K[0, 0] / 1.3
    assert np.nanpercentile(away, 95) < 0.25


def test_corners_cover_the_sheet(rendered: tuple[RenderedSequence, Path]) -> None:
    sequence, _ = rendered
    grey = cv2.cvtColor(sequence.images[0], cv2.COLOR_RGB2GRAY)
    x, y = corners(grey, np.isfinite(sequence.depth[0]), 12.0, np.empty((0, 2))).astype(int).T
    cells = np.floor((sequence.sheet[0, y, x] / [1.0, 0.75] + 0.5) * 8)
    _, count = np.unique(cells, axis=0, return_counts=True)
    assert len(count) == 64
    assert count.max() < 6 * count.min()


def test_same_images_same_tracks(rendered: tuple[RenderedSequence, Path]) -> None:
    sequence, folder = rendered
    config = TrackingConfig(points=300, every=2, first=1, last=11)
    first, second = (track_images(folder, sequence.K, config) for _ in range(2))
    np.testing.assert_array_equal(first.pixels, second.pixels)
    assert first.image_names == tuple(f"{k:03d}.png" for k in range(1, 12, 2))


def test_masks_keep_tracks_on_the_object(rendered: tuple[RenderedSequence, Path], tmp_path: Path) -> None:
    sequence, folder = rendered
    half = (sequence.sheet[..., 0] > 0).astype(np.uint8) * 255
    masks = write_all(tmp_path / "masks", half)
    tracks = track_images(folder, sequence.K, masks=masks)
    ab = sequence.sheet_at(tracks)
    assert tracks.n_points > 50
    assert np.nanmin(ab[..., 0]) > 0
    with pytest.raises(InputError, match=r"003\.png: has no mask"):
        track_images(folder, sequence.K, masks=sorted(masks.iterdir())[:3])
    with pytest.raises(InputError, match=r"mask 011\.png: has no image"):
        track_images(sorted(folder.iterdir())[:-1], sequence.K, masks=masks)
    small = write_all(tmp_path / "small", [np.full((10, 20), 255, np.uint8)] * 12)
    with pytest.raises(InputError, match=r"mask 000\.png: has 20 x 10 pixels, expected the 480 x 360"):
        track_images(folder, sequence.K, masks=small)


def test_black_surroundings_hold_no_tracks(tmp_path: Path) -> None:
    frames = []
    for k in range(4):
        frame = np.zeros((240, 320), np.uint8)
        frame[60:180, 80 + 2 * k : 240 + 2 * k] = texture(120, 160)
        frame[5:13, 5:13] = texture(8, 8, seed=1)
        frames.append(frame)
    tracks = track_images(write_all(tmp_path / "images", frames), K, TrackingConfig(points=200))
    assert tracks.n_points > 50
    assert (np.nanmin(tracks.pixels[0], axis=0) >= [84, 64]).all()
    lasting = tracks.pixels[:, tracks.visible.all(axis=0)]
    np.testing.assert_allclose(lasting[3] - lasting[0], np.tile([6.0, 0.0], (lasting.shape[1], 1)), atol=0.05)


def test_images_that_cannot_be_followed_are_named(tmp_path: Path) -> None:
    image = texture()
    cases = {
        "blank": ([image, np.full_like(image, 7), image], r"001\.png: is blank"),
        "smooth": ([np.tile(np.linspace(20, 200, 320), (240, 1)).astype(np.uint8)] * 3, r"000\.png: shows no corners"),
        "jump": ([image, texture(seed=5), image], r"001\.png: none of the points"),
        "sizes": ([image, image[:100]], r"001\.png: has 320 x 100 pixels"),
        "one": ([image], "one: shows 1 image, expected at least 3"),
    }
    for name, (images, expected) in cases.items():
        with pytest.raises(InputError, match=expected):
            track_images(write_all(tmp_path / name, images), K)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no images"):
        track_images(tmp_path / "empty", K)
    broken = write_all(tmp_path / "broken", [image] * 3) / "001.png"
    broken.write_bytes(broken.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"001\.png: cannot be read"):
        track_images(tmp_path / "broken", K)


def test_registration_finds_an_affinity_and_ignores_light() -> None:
    image = texture()
    affinity = np.array([[1.05, 0.08], [-0.06, 0.93]])
    centre = np.array([160.0, 120.0])
    shift = np.array([1.3, -0.8])
    # New image at x shows the old one at centre + A^-1 (x - centre - shift).
    matrix = np.column_stack([affinity, centre + shift - affinity @ centre])
    warped = cv2.warpAffine(image, matrix, (320, 240), flags=cv2.INTER_CUBIC)
    darker = np.clip(0.6 * warped.astype(float) + 30, 0, 255).astype(np.uint8)
    at = centre[None].astype(np.float32)
    start = at + np.array([1.0, -1.0])
    place, found, similarity = register(patches(image, at, 21), darker, start, np.eye(2)[None])
    np.testing.assert_allclose(place[0], centre + shift, atol=0.05)
    np.testing.assert_allclose(found[0], affinity, atol=0.02)
    assert similarity[0] > 0.98
    _, _, elsewhere = register(patches(image, at, 21), texture(seed=9), at, np.eye(2)[None])
    assert elsewhere[0] < 0.7


def test_neighbours_give_their_affinity_and_expose_one_wrong_point() -> None:
    rng = np.random.default_rng(0)
    before = rng.uniform(0, 100, (60, 2))
    A = np.array([[1.1, 0.2], [-0.1, 0.9]])
    after = before @ A.T + [5, -3]
    after[7] += [4, 0]
    linear, error = local_affinity(before, after, 10)
    others = np.arange(60) != 7
    assert error[7] == pytest.approx(4.0, abs=0.1)
    assert error[others].max() < 0.3
    np.testing.assert_allclose(np.median(linear, axis=0), A, atol=0.01)
    assert local_affinity(before[:3], after[:3], 10)[1].tolist() == [0, 0, 0]
    on_line = np.column_stack([np.arange(10.0), np.zeros(10)])
    np.testing.assert_allclose(local_affinity(on_line, on_line + 1, 5)[1], 0, atol=1e-3)


def test_corners_keep_their_distance() -> None:
    image = texture()
    everywhere = np.ones(image.shape, dtype=bool)
    taken = np.array([[100.0, 100.0]])
    found = corners(image, everywhere, 12.0, taken)
    assert len(found) > 150
    distances = np.linalg.norm(found[:, None] - found, axis=-1) + 1e3 * np.eye(len(found))
    assert distances.min() > 6
    assert np.linalg.norm(found - taken, axis=1).min() > 12
    assert len(corners(image, ~everywhere, 12.0, taken)) == 0


def test_large_black_areas_are_not_the_object_but_dark_print_is() -> None:
    image = np.zeros((100, 100), np.uint8)
    image[20:80, 20:80] = 150
    image[40:50, 40:50] = 0
    image[90:93, 90:93] = 150
    region = not_black(image, 21)
    assert region[45, 45]
    assert not region[91, 91]
    assert not region[5, 5]
    assert not not_black(np.zeros((50, 50), np.uint8), 21).any()


@pytest.mark.parametrize("chosen", [{"patch": 20}, {"patch": 3}, {"min_share": 0.0}, {"every": 0}, {"neighbours": 2}])
def test_impossible_settings_are_named(chosen: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(chosen))} is .*expected"):
        TrackingConfig(**chosen)


@pytest.mark.realdata
@pytest.mark.slow
def test_hanging_cloth_keeps_tracks_over_all_images(realdata) -> None:
    folder = realdata("cloth_r1")
    tracks = track_images(folder / "images", parse_intrinsics(folder / "K.txt"))
    assert tracks.n_frames == 50
    assert tracks.visible.all(axis=0).sum() >= 300
    assert check_reconstructable(tracks)[1] == ()
