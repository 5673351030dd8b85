"""Renders for papers, the recording for rerun, photos and the scale of every image."""

from __future__ import annotations

import builtins
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.report.image_scale import log_image_scale
from connrsfm_graph.report.photos import LONGEST, photos_of
from connrsfm_graph.report.recording import write_recording
from connrsfm_graph.report.renders import write_renders

from .test_page import bowls

IMAGES = [np.full((480, 640, 3), (180, 40, 40), np.uint8)] * 3


def test_renders_in_every_colouring_at_the_width_asked_for(tmp_path: Path) -> None:
    made = bowls(F=3)
    folder = write_renders(tmp_path, made, 200, (10.0, 0.0), truth=made.points * [1, 1, 1.1], images=iter(IMAGES))
    assert folder == tmp_path / "renders"
    kinds = ("conformal-scale", "depth", "error", "image")
    assert sorted(path.name for path in folder.iterdir()) == [f"{f:04d}_{kind}.png" for f in range(3) for kind in kinds]
    picture = cv2.imread(str(folder / "0001_image.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape[1:] == (200, 4)
    columns = np.flatnonzero(picture[..., 3].any(axis=0))
    assert columns[0] < 30
    assert columns[-1] > 170
    blue, green, red = picture[picture[..., 3] == 255][:, :3].mean(axis=0)
    assert red > 3 * green == pytest.approx(3 * blue, abs=3)
    assert picture[0, 0, 3] == 0


def test_without_images_and_truth_renders_show_what_is_known(tmp_path: Path) -> None:
    folder = write_renders(tmp_path, bowls(F=2), 60)
    assert {path.name for path in folder.iterdir()} == {
        f"{f:04d}_{kind}.png" for f in range(2) for kind in ("depth", "conformal-scale")
    }


def test_recording_is_written_where_rerun_is_installed(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra 'viz' is not installed")
    made = bowls(F=3)
    path = write_recording(tmp_path / "out.rrd", tmp_path, made, truth=made.points, images=iter(IMAGES))
    assert path.read_bytes()[:4] == b"RRF2"
    assert path.stat().st_size > 10_000


def test_without_rerun_one_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "rerun":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match="install the extra 'viz'"):
        write_recording(tmp_path / "out.rrd", tmp_path, bowls(F=3))
    with pytest.raises(InputError, match=r"ends in \.rrd"):
        write_recording(tmp_path / "out.txt", tmp_path, bowls(F=3))
    assert list(tmp_path.iterdir()) == []


def test_photos_show_where_the_tracks_are_and_know_where_a_pixel_went() -> None:
    x, y = np.meshgrid(np.arange(1600.0), np.arange(900.0))
    image = np.stack([x / 8, y / 8, 0 * x], axis=-1).astype(np.uint8)
    pixels = np.array([[[400.0, 200.0], [1200.0, 300.0], [800.0, 700.0]]])
    (photo,) = photos_of([image], pixels)
    assert max(photo.image.shape) == LONGEST
    place = np.round(photo.place(pixels[0])).astype(int)
    np.testing.assert_allclose(photo.image[place[:, 1], place[:, 0], :2], pixels[0] / 8, atol=1.5)
    (grey,) = photos_of([image[..., 0]], pixels)
    assert grey.image.shape == photo.image.shape
    assert photo.jpeg().startswith("data:image/jpeg;base64,/9j/")


def test_image_scale_explains_the_edges_and_has_mean_zero() -> None:
    made = bowls(F=5, P=7)
    s = np.random.default_rng(0).normal(size=(5, 7))
    s -= s.mean(axis=0)
    a, b = made.edges.T
    scale = np.exp(s[b] - s[a])
    scale[1, 3] = np.nan  # still a spanning tree
    scale[:, 5] = np.nan
    found = log_image_scale(replace(made, conformal_scale=scale))
    assert np.isnan(found[:, 5]).all()
    np.testing.assert_allclose(np.delete(found, 5, axis=1), np.delete(s, 5, axis=1), atol=1e-9)
