"""The main job on real and synthetic tracks: bounds, backends, missing data, promises about its output."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.config import override
from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.reconstruct import Config, default_config, reconstruct
from connrsfm_graph.running.config import RunningConfig
from connrsfm_graph.synthetic import isometric_bending, spheres, with_missing, with_noise
from connrsfm_graph.tracks import Tracks, load_tracks
from factors.surface import PERSPECTIVE, metric


def errors(tracks: Tracks, config: Config | None = None) -> tuple[float, float]:
    """3D error in percent and shape error in degrees; everything must be recovered."""
    result, _ = reconstruct(tracks, config)
    evaluation = evaluate(result.points, tracks.points, tracks.visible)
    assert evaluation.coverage == 1.0
    return evaluation.e3d_percent, evaluation.shape_error_deg


REAL = {
    # file, pixels of noise, bound of the paper mode, bounds of the default mode
    "T-shirt": ("tshirt.npz", 0.0, 2.24, (0.40, 3.6)),
    "KinectPaper": ("kinect_paper.npz", 0.0, 1.2, (0.40, 3.1)),
    "Flag": ("flag.npz", 0.0, 1.0, (0.35, 4.2)),
    "Flag, 4 px": ("flag.npz", 4.0, 1.95, (1.0, 8.0)),
}


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_real_data(name: str, realdata: Callable[[str], Path]) -> None:
    file, pixels, paper_bound, default_bounds = REAL[name]
    tracks = load_tracks(realdata(file))
    tracks = with_noise(tracks, pixels) if pixels else tracks
    paper, _ = errors(tracks, default_config("paper"))
    assert paper <= paper_bound
    default, shape = errors(tracks)
    assert default <= min(paper, default_bounds[0])
    assert shape <= default_bounds[1]


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.parametrize("mode", ["paper", "default"])
def test_backends_agree_on_the_whole_run(mode, realdata: Callable[[str], Path]) -> None:
    tracks = load_tracks(realdata("tshirt.npz"))
    config = default_config(mode)
    results = [reconstruct(tracks, override(config, [f"solve.backend={name}"]))[0] for name in ("batched", "gtsam")]
    a, b = (result.points for result in results)
    assert np.abs(a - b).max() < 1e-6 * np.abs(a).max()
    assert results[0].conformal_scale == pytest.approx(results[1].conformal_scale, rel=1e-6)


@pytest.fixture(scope="module")
def bent():
    scene = isometric_bending(n_frames=6, n_points=80)
    return scene, *reconstruct(scene.tracks)


def test_noise_free_bending_is_recovered(bent):
    scene, result, record = bent
    evaluation = evaluate(result.points, scene.tracks.points)
    assert evaluation.e3d_percent < 0.05
    angle = np.degrees(np.arccos(np.clip((result.normals * scene.tracks.normals).sum(axis=-1), -1, 1)))
    assert np.median(angle) < 1.0
    assert record.decisions["model"] == "isometric"


def test_terms_and_scales_belong_to_the_points(bent):
    scene, result, _ = bent
    image = result.points[..., :2] / result.points[..., 2:]
    assert result.depth == pytest.approx(result.points[..., 2])
    assert np.linalg.norm(result.normals, axis=-1) == pytest.approx(1)
    assert ((result.normals * result.points).sum(axis=-1) < 0).all()
    # lambda^2 is the ratio of the metrics of both surfaces, through the exact warp.
    a, b = result.edges.T
    J = scene.jets(result.edges).jacobian
    g_a = metric(image[a], result.first_order[a], result.depth[a])
    g_b = np.swapaxes(J, -1, -2) @ metric(image[b], result.first_order[b], result.depth[b]) @ J
    ratio = np.sqrt(np.linalg.det(g_a) / np.linalg.det(g_b)) ** 0.5
    assert np.median(np.abs(np.log(result.conformal_scale / ratio))) < 0.01


def test_missing_points(bent):
    scene, *_ = bent
    tracks = with_missing(scene.tracks, 0.3)
    result, _ = reconstruct(tracks)
    evaluation = evaluate(result.points, tracks.points, tracks.visible)
    assert evaluation.coverage == 1.0
    assert evaluation.e3d_percent < 0.5
    unobserved = np.isnan(result.conformal_scale)
    a, b = result.edges.T
    assert (unobserved | (tracks.visible[a] & tracks.visible[b])).all()


def test_paper_mode_recovers_spheres():
    tracks = spheres(n_frames=5, n_points=80).tracks
    paper, _ = errors(tracks, default_config("paper"))
    default, _ = errors(tracks)
    assert default < paper < 2.5


def test_same_input_same_result(bent):
    scene, result, _ = bent
    again, _ = reconstruct(scene.tracks)
    assert (again.points == result.points).all()


def test_images_without_common_tracks_are_named():
    scene = isometric_bending(n_frames=4, n_points=60)
    visible = scene.tracks.visible.copy()
    visible[:2, 30:] = visible[2:, :30] = False
    tracks = Tracks.checked(scene.tracks.pixels, scene.tracks.K, visible)
    with pytest.raises(InputError, match=r"frames 0-1; 2-3"):
        reconstruct(tracks)


def test_camera_points_project_to_the_tracks(bent):
    scene, result, _ = bent
    image = scene.tracks.normalised()
    expected = PERSPECTIVE.points(image, result.depth)
    assert np.abs(result.points - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_cluster_that_is_not_needed_is_not_asked():
    tracks = isometric_bending(n_frames=4, n_points=40).tracks
    _, record = reconstruct(tracks, Config(running=RunningConfig(cluster="tcp://nowhere:1")))
    assert "the cluster was not asked: all 4 images are reconstructed jointly, here" in record.warnings
