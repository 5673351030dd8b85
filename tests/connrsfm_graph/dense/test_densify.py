"""Dense surfaces of a known sheet: depth, region, files, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.dense import choose as choosing
from connrsfm_graph.dense.densify import FEWEST_POINTS, densify
from connrsfm_graph.dense.layout import DENSE_FOLDER, DenseIndex, read_depth
from connrsfm_graph.errors import InputError
from connrsfm_graph.export.depth_png import read_depth_png
from factors.surface import ORTHOGRAPHIC
from tests.connrsfm_graph.dense.surface import SIZE, sheet, true_log_depth, write_images

PIXELS = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    return write_images(tmp_path / "images")


def test_spline_gives_the_depth_of_every_pixel_inside(tmp_path: Path, images: Path) -> None:
    index = densify(sheet(), images, tmp_path / "out", "spline")
    assert (index.method, index.checkpoint, index.skipped, index.warnings) == ("spline", None, [], [])
    for frame in index.frames:
        depth = read_depth(tmp_path / "out" / DENSE_FOLDER, frame)
        truth = np.exp(true_log_depth(PIXELS, frame.frame))
        known = np.isfinite(depth)
        # The points span [40, 280] x [30, 200]; slivers along the hull may be left out.
        assert known[40:190, 55:265].mean() > 0.995
        assert not known[:29].any()
        assert not known[:, 282:].any()
        assert np.abs(depth / truth - 1.0)[known].max() < 2e-3
        assert frame.residual_percent < 0.05
        assert frame.covered == pytest.approx(known.mean())


def test_holes_stay_open(tmp_path: Path, images: Path) -> None:
    densify(sheet(hole=45.0), images, tmp_path, "spline")
    index = DenseIndex.load(tmp_path / DENSE_FOLDER)
    depth = read_depth(tmp_path / DENSE_FOLDER, index.frames[0])
    far_inside = np.linalg.norm(PIXELS - np.array(SIZE) / 2, axis=-1) < 25
    assert not np.isfinite(depth[far_inside]).any()
    assert np.isfinite(depth[40:60, 60:260]).all()


def test_wrong_and_unseen_points_take_no_part(tmp_path: Path, images: Path) -> None:
    true = sheet()
    points, outlier, visible = true.points.copy(), true.outlier.copy(), true.visible.copy()
    points[:, 20:30] *= 5.0
    outlier[:, 20:25], visible[:, 25:30] = True, False
    index = densify(replace(true, points=points, outlier=outlier, visible=visible), images, tmp_path, "spline")
    assert index.frames[0].points == 190
    assert index.frames[0].residual_percent < 0.05


def test_the_png_holds_the_same_depth(tmp_path: Path, images: Path) -> None:
    index = densify(sheet(n_frames=1), images / "000.png", tmp_path, "spline")
    folder, frame = tmp_path / DENSE_FOLDER, index.frames[0]
    depth, steps = read_depth(folder, frame), read_depth_png(folder / frame.depth_png, index.depth_png_scale)
    assert (np.isfinite(depth) == np.isfinite(steps)).all()
    assert np.nanmax(np.abs(depth - steps)) <= 0.51 / index.depth_png_scale
    assert np.nanmax(depth) * index.depth_png_scale > 65535 / 4, "the 16 bits are used"


def test_the_index_reads_back_and_names_files_that_exist(tmp_path: Path, images: Path) -> None:
    index = densify(sheet(), images, tmp_path, "spline")
    folder = tmp_path / DENSE_FOLDER
    assert DenseIndex.load(folder) == index
    for frame in index.frames:
        for file in (frame.depth, frame.depth_png, frame.texture, frame.glb, frame.ply, index.sequence):
            assert (folder / file).stat().st_size > 0
    (folder / "index.json").write_text(json.dumps({"format": 1}))
    with pytest.raises(InputError, match="not written by 'densify'"):
        DenseIndex.load(folder)


def test_images_with_few_points_are_left_out_with_a_reason(tmp_path: Path, images: Path) -> None:
    true = sheet()
    visible = true.visible.copy()
    visible[1, FEWEST_POINTS - 1 :] = False
    index = densify(replace(true, visible=visible), images, tmp_path, "spline")
    assert [frame.frame for frame in index.frames] == [0, 2]
    assert [(item["frame"], item["name"]) for item in index.skipped] == [(1, "001.png")]
    with pytest.raises(InputError, match=r"no image has a dense surface; 000\.png has 0 recovered points"):
        densify(replace(true, visible=np.zeros_like(visible)), images, tmp_path, "spline")


def test_orthographic_cameras_are_refused(tmp_path: Path, images: Path) -> None:
    with pytest.raises(InputError, match="of an orthographic camera"):
        densify(replace(sheet(), camera=ORTHOGRAPHIC), images, tmp_path, "spline")


def test_points_on_a_line_span_no_surface(tmp_path: Path, images: Path) -> None:
    true = sheet()
    points = true.points.copy()
    points[1, :, 1] = 0.1 * points[1, :, 2]
    index = densify(replace(true, points=points), images, tmp_path, "spline")
    assert [(item["frame"], item["reason"]) for item in index.skipped] == [(1, "points on a line")]


def test_images_are_found_by_name_among_more(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "images", count=5)
    true = replace(sheet(n_frames=2), image_names=np.array(["001.png", "004.png"]))
    index = densify(true, folder, tmp_path, "spline")
    assert [frame.name for frame in index.frames] == ["001.png", "004.png"]
    with pytest.raises(InputError, match=r"holds 5 images, expected 2 or some named like 001\.png"):
        densify(replace(true, image_names=np.array(["001.png", "007.png"])), folder, tmp_path, "spline")


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda folder: (folder / "002.png").unlink(), "holds 2 images, expected 3"),
        (lambda folder: (folder / "001.png").write_bytes(b"no image"), "001.png: cannot be read as an image"),
        (lambda folder: (folder / "001.png").write_bytes((folder / "001.png").read_bytes()[:200]), "001.png"),
        (lambda folder: [file.unlink() for file in folder.iterdir()], "holds no images"),
    ],
    ids=["missing", "corrupt", "cut off", "empty"],
)
def test_bad_images_are_one_sentence_and_leave_nothing(
    tmp_path: Path, images: Path, spoil: Callable[[Path], object], told: str
) -> None:
    spoil(images)
    with pytest.raises(InputError, match=told):
        densify(replace(sheet(), image_names=None), images, tmp_path / "out", "spline")
    assert not (tmp_path / "out").exists()


def test_images_of_another_size_are_refused(tmp_path: Path) -> None:
    smaller = write_images(tmp_path / "smaller", size=(160, 120))
    with pytest.raises(InputError, match=r"160 x 120 pixels but tracks of 000\.png reach x = 280"):
        densify(sheet(), smaller, tmp_path / "out", "spline")
    larger = write_images(tmp_path / "larger", size=(640, 480))
    assert "check that the images" in densify(sheet(), larger, tmp_path / "out", "spline").warnings[0]


def test_without_torch_the_spline_is_chosen_and_the_network_refused(
    tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choosing, "find_spec", lambda name: None)
    index = densify(sheet(), images, tmp_path)
    assert (index.method, index.reason) == ("spline", "the network needs torch, which is not installed")
    with pytest.raises(InputError, match=r"pip install '\.\[dense\]'"):
        densify(sheet(), images, tmp_path, "network")
