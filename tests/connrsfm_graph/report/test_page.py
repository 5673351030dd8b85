"""The page is self-contained, says what the run says, and copes with whatever a reconstruction lacks."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.charts import bar_chart, duration_chart, graph_chart, line_chart, range_chart
from connrsfm_graph.report.mesh import triangles
from connrsfm_graph.report.page import MAX_FRAMES, write_report
from connrsfm_graph.report.surfaces import Surfaces
from connrsfm_graph.run_record import RunRecord

RECORD = RunRecord(
    source="folder/<tracks>.npz",
    method="connrsfm",
    seed=0,
    configuration={"solve": {"backend": "batched & more"}},
    decisions={"pixel_sigma": 0.51234, "sigmas": [1.0, 0.1]},
    warnings=("2 points < 3 points",),
    cost_history={"joint": [3.0, 2.0, 1.0], "refine": [1.0, 0.1]},
    seconds={"warps": 1.0, "solve": 2.0},
)


def bowls(F: int = 5, P: int = 40) -> Reconstruction:
    rng = np.random.default_rng(1)
    image = rng.uniform(-0.3, 0.3, (F, P, 2))
    depth = 3.0 + (image**2).sum(axis=-1)
    edges = np.array([(f, (f + 1) % F) for f in range(F)])
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    return Reconstruction(
        pixels=500 * image + [320, 240],
        K=np.tile(K, (F, 1, 1)),
        visible=np.ones((F, P), bool),
        points=np.concatenate([image * depth[..., None], depth[..., None]], axis=-1),
        normals=np.tile([0.0, 0.0, -1.0], (F, P, 1)),
        depth=depth,
        first_order=np.zeros((F, P, 2)),
        second_order=np.zeros((F, P, 3)),
        edges=edges,
        edge_weight=np.arange(1.0, F + 1),
        conformal_scale=np.exp(0.1 * rng.normal(size=(F, P))),
        depth_std=np.full((F, P), np.nan),
        log_factor=np.zeros((F, P)),
        interpolated=np.zeros((F, P), bool),
        outlier=np.zeros((F, P), bool),
    )


def test_page_is_self_contained_and_escaped(tmp_path: Path) -> None:
    made = bowls()
    truth = made.points * [1.0, 1.0, 1.02]
    page = write_report(tmp_path / "out", made, RECORD, truth, evaluate(made.points, truth))
    text = page.read_text()
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "http" not in text
    for shown in (
        "&lt;tracks&gt;.npz",
        "2 points &lt; 3 points",
        "batched &amp; more",
        "0.5123",
        "3D error",
        "Image graph",
    ):
        assert shown in text
    assert "<tracks>" not in text
    pictures = sorted((tmp_path / "out" / "pictures").iterdir())
    assert [path.name for path in pictures[:4]] == [
        "0000_error.png",
        "0000_side.png",
        "0000_tracks.png",
        "0000_truth.png",
    ]
    assert len(pictures) == 20
    assert all(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., 3].any() for path in pictures)


def test_long_sequences_show_some_images(tmp_path: Path) -> None:
    text = write_report(tmp_path, bowls(F=30, P=12), RECORD).read_text()
    assert text.count("<section class=frame>") == MAX_FRAMES
    assert f"{MAX_FRAMES} of 30 images" in text


@pytest.mark.filterwarnings("error")
def test_missing_and_empty_parts(tmp_path: Path) -> None:
    made = bowls()
    points, scale = made.points.copy(), made.conformal_scale.copy()
    points[2] = np.nan
    points[3, 5:] = np.nan
    scale[1] = np.nan
    visible = made.visible.copy()
    visible[:, 7] = False
    pixels = np.where(visible[..., None], made.pixels, np.nan)
    outlier = np.zeros_like(visible)
    outlier[0, 3] = True
    made = replace(
        made,
        points=points,
        conformal_scale=scale,
        visible=visible,
        pixels=pixels,
        outlier=outlier,
        interpolated=outlier,
    )
    bare = replace(RECORD, cost_history={}, seconds={}, decisions={}, warnings=())
    text = write_report(tmp_path, made, bare).read_text()
    assert text.count("<section class=frame>") == 4
    nothing = replace(made, points=np.full_like(points, np.nan), edges=np.empty((0, 2), int), edge_weight=np.empty(0))
    nothing = replace(nothing, conformal_scale=np.empty((0, points.shape[1])))
    assert "<canvas" not in write_report(tmp_path, nothing, bare).read_text()
    assert list((tmp_path / "pictures").iterdir()) == []


def test_images_lie_under_the_tracks(tmp_path: Path) -> None:
    made = bowls(F=3)
    write_report(tmp_path, made, RECORD, images=[np.full((480, 640, 3), (0, 90, 0), np.uint8)] * 3)
    picture = cv2.imread(str(tmp_path / "pictures" / "0000_tracks.png"), cv2.IMREAD_UNCHANGED)
    blue, green, red, alpha = picture[2, 2].tolist()
    assert alpha == 255
    assert 127 < green == red == blue < 255
    assert picture.shape[1] == pytest.approx(picture.shape[0], rel=0.02), "cut to the square in which the tracks are"


def test_surfaces_are_aligned_and_errors_are_distances() -> None:
    made = bowls()
    truth = 2.5 * made.points + [1.0, 2.0, 3.0]
    truth[0, 0, 2] += 0.05 * np.ptp(truth[0], axis=0).max()
    surfaces = Surfaces.of(made, truth)
    assert surfaces.error is not None
    np.testing.assert_allclose(surfaces.points[1:], truth[1:], atol=1e-9)
    assert surfaces.error[1:].max() < 1e-6
    assert 3.0 < surfaces.error[0, 0] < 5.0
    with pytest.raises(InputError, match="the truth has shape"):
        Surfaces.of(made, truth[:2])
    with pytest.raises(InputError, match="fewer than 3 points"):
        Surfaces.of(made, np.full_like(truth, np.nan))


def test_triangles_do_not_bridge_gaps() -> None:
    x, y = np.meshgrid(np.arange(6.0), np.arange(6.0))
    sheet = np.column_stack([x.ravel(), y.ravel()])
    sheet += 0.01 * np.random.default_rng(0).normal(size=sheet.shape)
    two = np.concatenate([sheet, sheet + np.array([40.0, 0.0]), [[np.nan, np.nan]]])
    left = (triangles(two) < 36).sum(axis=1)
    assert set(left.tolist()) == {0, 3}
    assert triangles(np.column_stack([np.arange(5.0), np.arange(5.0)])).shape == (0, 3)
    assert triangles(np.full((5, 2), np.nan)).shape == (0, 3)


def test_charts_are_well_formed() -> None:
    charts = [
        bar_chart([1.0, None, 3.0], ["a", "b<", "c"], "%"),
        bar_chart([0.0, 0.0], ["a", "b"], "%"),
        range_chart([(0.5, 1.0, 2.0), None], ["0–1", "1–2"], "λ"),
        range_chart([(1.0, 1.0, 1.0)], ["0–1"], "λ"),
        line_chart({"one": [1e3, 1.0, 0.0, 1e-9]}, "cost"),
        line_chart({"one": [2.0, 2.0]}, "cost"),
        duration_chart({"a & b": 0.0}),
        graph_chart(3, np.array([[0, 1], [1, 2]]), np.array([0.0, 2.0])),
        graph_chart(1, np.empty((0, 2), int), np.empty(0)),
    ]
    for chart in charts:
        root = ElementTree.fromstring(chart)
        for element in root.iter():
            for value in element.attrib.values():
                assert "nan" not in value
                assert "inf" not in value
    assert (
        bar_chart([None], ["a"], "%")
        == range_chart([None], ["a"], "")
        == line_chart({}, "")
        == duration_chart({})
        == ""
    )
    bars = ElementTree.fromstring(charts[0]).findall("rect")
    heights = [float(bar.attrib["height"]) for bar in bars]
    assert heights[1] / heights[0] == pytest.approx(3.0, rel=0.01)
