"""The error of depth that stays with the image, found from the lengths of the truth alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.refine.mesh import surface_mesh
from connrsfm_graph.synthetic import isometric_bending
from experiments.truth import compare, corrected, cross_corrected, depth_field, markdown, stretch, terms


def bent_sheets() -> tuple[np.ndarray, np.ndarray]:
    scene = isometric_bending(n_frames=12, n_points=200, seed=0)
    assert scene.tracks.points is not None
    mesh = surface_mesh(scene.tracks.pixels[0], lambda edges: np.zeros(len(edges)))
    return scene.tracks.points, mesh.edges[: mesh.n_near]


def test_the_field_of_a_sensor_is_found_and_undone() -> None:
    points, edges = bent_sheets()
    field = np.array([0.02, -0.05, 0.03, -0.02, 0.04, 0.2, -0.1, 0.1, 0.15])
    measured = corrected(points, field)
    assert np.median(np.abs(stretch(measured, edges))) > 2.0 * np.median(np.abs(stretch(points, edges)))
    moved = np.log(cross_corrected(measured, edges)[..., 2] / points[..., 2])
    before = np.log(measured[..., 2] / points[..., 2])
    for change in (moved, before):
        change -= change.mean(axis=1, keepdims=True)
    assert moved.std() < 0.15 * before.std()
    np.testing.assert_allclose(corrected(measured, np.zeros(9)), measured)
    directions = points / np.linalg.norm(points, axis=-1, keepdims=True)
    np.testing.assert_allclose(measured / np.linalg.norm(measured, axis=-1, keepdims=True), directions)


def test_nothing_is_found_where_nothing_is() -> None:
    points, edges = bent_sheets()
    change = terms(points) @ depth_field(points, edges)
    assert (change - change.mean(axis=1, keepdims=True)).std() < 1e-3


@pytest.mark.realdata
@pytest.mark.slow
def test_the_truth_of_kinect_paper_has_such_an_error_and_the_flag_has_none(realdata: Callable[[str], Path]) -> None:
    paper, flag = (compare(name, realdata(name), ["default"])[0] for name in ("kinect_paper.npz", "flag.npz"))
    assert paper.corrected_stretch_percent < 0.9 * paper.stretch_percent
    assert paper.corrected_e3d_percent < 0.7 * paper.e3d_percent
    assert flag.corrected_stretch_percent > 0.95 * flag.stretch_percent
    assert "| kinect_paper.npz | 0." in markdown([paper, flag])
