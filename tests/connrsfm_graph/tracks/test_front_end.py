"""Keyframes follow the motion, the lens is undone, and tracks that slip are dropped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.rendered import RenderConfig, render_sequence
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.tracks.draw import draw_sequence
from connrsfm_graph.tracks.front_end import images_to_tracks
from connrsfm_graph.tracks.keyframes import keyframes
from connrsfm_graph.tracks.lens import parse_distortion, undistort_image, undistort_pixels
from connrsfm_graph.tracks.wrong import wrong_tracks

K = np.array([[500.0, 0, 320], [0, 490, 240], [0, 0, 1]])
LENS = parse_distortion("-0.25, 0.08, 0.001, -0.002, 0.01")


def waving(F: int = 12, P: int = 150, seed: int = 0) -> Tracks:
    """Points of a sheet that waves smoothly, with a tenth of a pixel of noise."""
    rng = np.random.default_rng(seed)
    at = rng.uniform([100, 80], [540, 400], (P, 2))
    time = np.linspace(0, 1, F)[:, None]
    wave = np.stack([12 * np.sin(4 * time + at[:, 1] / 90), 9 * np.cos(3 * time + at[:, 0] / 110)], axis=-1)
    return Tracks.checked(at + wave + 0.1 * rng.normal(size=(F, P, 2)), K)


def test_keyframes_are_even_by_motion_not_time() -> None:
    place = np.concatenate([np.zeros(20), np.arange(0, 100, 10), np.full(20, 90.0)])
    points = np.random.default_rng(0).uniform(0, 100, (30, 2))
    tracks = Tracks.checked(points + np.stack([place, 0 * place], axis=1)[:, None], K)
    chosen = keyframes(tracks, 10)
    assert chosen[0] == 0
    assert chosen[-1] == 49
    np.testing.assert_allclose(np.diff(place[chosen]), 10)
    assert keyframes(tracks, 50).tolist() == list(range(50))
    assert len(set(keyframes(tracks, 40).tolist())) == 40
    for number in (2, 51):
        with pytest.raises(InputError, match=f"{number} keyframes asked for, expected 3 to 50"):
            keyframes(tracks, number)


def test_a_cut_between_images_counts_as_motion() -> None:
    tracks = waving(F=8)
    hidden = tracks.pixels.copy()
    hidden[:4, :75] = np.nan
    hidden[4:, 75:] = np.nan
    chosen = keyframes(Tracks.checked(hidden, K), 4)
    assert ((chosen < 4).sum(), (chosen >= 4).sum()) == (2, 2)


def test_lens_is_undone_exactly() -> None:
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, 50), rng.uniform(-0.45, 0.45, 50)])
    x, y = rays.T
    k1, k2, p1, p2, k3 = LENS
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    seen = np.column_stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y]
    )
    pixels, ideal = (part * np.diag(K)[:2] + K[:2, 2] for part in (seen, rays))
    assert np.abs(pixels - ideal).max() > 10
    pixels[3] = np.nan
    found = undistort_pixels(pixels, K, LENS)
    assert np.isnan(found[3]).all()
    np.testing.assert_allclose(np.delete(found, 3, axis=0), np.delete(ideal, 3, axis=0), atol=1e-6)


def test_impossible_lenses_are_named() -> None:
    for text in ("1,2,3", "a,b,c,d", "0,0,0,nan", "1,2,3,4,5,6"):
        with pytest.raises(InputError, match="expected k1,k2,p1,p2"):
            parse_distortion(text)
    with pytest.raises(InputError, match="no ray is seen at pixel"):
        undistort_pixels(np.array([[[600.0, 400.0]]]), K, np.array([-3.0, 0, 0, 0]))


def test_slipped_tracks_are_found_and_right_ones_kept() -> None:
    tracks = waving()
    assert wrong_tracks(tracks).sum() <= 1
    pixels = tracks.pixels.copy()
    slipped = [3, 40, 77, 110]
    pixels[5:, slipped] += [3.0, -2.0]
    wrong = wrong_tracks(replace(tracks, pixels=pixels))
    assert wrong[slipped].all()
    assert wrong.sum() <= len(slipped) + 1


def test_from_images_through_a_lens(tmp_path: Path) -> None:
    sequence = render_sequence(RenderConfig(frames=6, width=320, height=240, focal=310))
    lens = np.array([-0.2, 0.05, 0, 0])
    # The picture of a lens is the ideal picture looked up where the lens's pixels come from.
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    ideal = undistort_pixels(grid, sequence.K, lens).astype(np.float32)
    for number, image in enumerate(sequence.images):
        seen = cv2.remap(image, ideal[..., 0], ideal[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(str(tmp_path / f"{number}.png"), seen[..., ::-1])
    tracked = images_to_tracks(tmp_path, sequence.K, distortion=lens, n_keyframes=4)
    tracks = tracked.tracks
    assert tracks.n_frames == 4
    assert 0 <= tracked.wrong < 20
    assert tracks.image_names is not None
    frames = [int(name[0]) for name in tracks.image_names]
    part = replace(sequence, sheet=sequence.sheet[frames], surfaces=tuple(sequence.surfaces[f] for f in frames))
    ab = part.sheet_at(tracks)
    ab = ab[:, np.isfinite(ab).any(axis=(0, 2))]
    away = np.linalg.norm(ab - np.nanmedian(ab, axis=0), axis=-1) * 310 / 1.3
    assert np.nanpercentile(away, 90) < 0.3

    images = [undistort_image(cv2.imread(str(tmp_path / name)), sequence.K, lens) for name in tracks.image_names]
    inside = np.isfinite(sequence.depth[frames[0]])
    difference = np.abs(images[0][..., ::-1].astype(float) - sequence.images[frames[0]])[inside]
    assert np.median(difference) < 6
    picture = draw_sequence(images, tracks)
    assert picture.shape[1] == pytest.approx(1800, abs=6)
    assert picture.std() > 20
