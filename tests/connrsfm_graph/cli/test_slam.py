"""The command `slam`, on a finished reconstruction: what it writes, and what it refuses."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.slam import Fused, load_problem, read_tum, solve_problem, trajectory_error, write_tum
from connrsfm_graph.slam.trajectory import chained
from connrsfm_graph.synthetic.passing_camera import noisy_odometry, passing_camera, relative_depth
from connrsfm_graph.synthetic.scene import INTRINSICS
from connrsfm_graph.tracks import load_tracks
from tests.connrsfm_graph.cli.conftest import Config, answer

F, P, B = 15, 30, 20


@pytest.fixture
def scene():
    return passing_camera(F, P, B)


@pytest.fixture
def files(tmp_path: Path, scene) -> dict[str, Path]:
    """Tracks, result, odometry and background of one sequence."""
    rng = np.random.default_rng(0)
    image = scene.image + 1e-3 * rng.normal(size=scene.image.shape)
    depth = np.exp(relative_depth(scene))
    points = depth[..., None] * np.concatenate([image, np.ones((F, P, 1))], axis=-1)
    pixels = image * INTRINSICS[0, 0] + INTRINSICS[:2, 2]
    paths = {name: tmp_path / name for name in ("tracks.npz", "result.npz", "odometry.tum", "background.npz")}
    np.savez(paths["tracks.npz"], tracks=pixels, K=INTRINSICS)
    bowl, _ = answer(load_tracks(paths["tracks.npz"]), Config(), Progress())
    replace(bowl, points=points, depth=depth).save(paths["result.npz"])
    steps, _ = noisy_odometry(scene.poses)
    write_tum(paths["odometry.tum"], chained(steps, scene.poses[0]), np.arange(F) / 30.0)
    seen = np.where(scene.background_visible[..., None], scene.background_image, np.nan)
    np.savez(paths["background.npz"], tracks=seen * INTRINSICS[0, 0] + INTRINSICS[:2, 2], K=INTRINSICS)
    return paths


def test_trajectory_map_and_problem(connrsfm, files, scene, tmp_path):
    out = tmp_path / "out"
    ended = connrsfm(
        *("slam", files["tracks.npz"], "--result", files["result.npz"], "--out", out),
        *("--odometry", files["odometry.tum"], "--background", files["background.npz"]),
    )
    assert ended.status == 0, ended.err
    assert "in the unit of odometry" in ended.out
    times, poses = read_tum(out / "trajectory.tum")
    np.testing.assert_allclose(times, np.arange(F) / 30.0, atol=1e-8)
    _, odometry = read_tum(files["odometry.tum"])
    assert trajectory_error(poses, scene.poses).ate < trajectory_error(odometry, scene.poses).ate
    assert (out / "map.ply").read_bytes().startswith(b"ply\n")
    assert "rigid landmarks" in (out / "graph.dot").read_text()
    np.testing.assert_allclose(solve_problem(load_problem(out / "problem.npz")).poses, poses, atol=1e-6)


def test_without_odometry_the_unit_is_the_reconstructions(connrsfm, files, tmp_path):
    ended = connrsfm("slam", files["tracks.npz"], "--result", files["result.npz"], "--out", tmp_path / "out")
    assert ended.status == 0, ended.err
    assert "in the unit of the first view's reconstruction" in ended.out


def test_odometry_that_never_moves_holds_the_camera_and_gives_no_unit(connrsfm, files, tmp_path):
    still = tmp_path / "still.tum"
    write_tum(still, np.tile(np.eye(4), (F, 1, 1)))
    out = tmp_path / "out"
    ended = connrsfm(
        *("slam", files["tracks.npz"], "--result", files["result.npz"], "--odometry", still, "--out", out),
    )
    assert ended.status == 0, ended.err
    assert "in the unit of the first view's reconstruction" in ended.out
    _, poses = read_tum(out / "trajectory.tum")
    assert np.abs(poses[:, :3, 3]).max() < 0.02


def test_views_one_by_one(connrsfm, files, scene, tmp_path):
    """The first ten reconstructed before, five more from their tracks."""
    known = Reconstruction.load(files["result.npz"])
    bowl, _ = answer(load_tracks(files["tracks.npz"]).select(frames=range(10)), Config(), Progress())
    replace(bowl, points=known.points[:10], depth=known.depth[:10]).save(tmp_path / "ten.npz")
    given = ("slam", files["tracks.npz"], "--result", tmp_path / "ten.npz", "--odometry", files["odometry.tum"])
    out = tmp_path / "out"
    ended = connrsfm(*given, "--live", "10", "--out", out)
    assert ended.status == 0, ended.err
    _, poses = read_tum(out / "trajectory.tum")
    assert len(poses) == F
    np.testing.assert_allclose(solve_problem(load_problem(out / "problem.npz")).poses, poses, atol=1e-3)
    ended = connrsfm(*given, "--live", "10", "--background", files["background.npz"], "--out", tmp_path / "held")
    assert ended.status == 0, ended.err
    _, held = read_tum(tmp_path / "held" / "trajectory.tum")
    assert trajectory_error(held, scene.poses).rpe_rotation_deg < trajectory_error(poses, scene.poses).rpe_rotation_deg
    with np.load(files["tracks.npz"]) as arrays:
        visible = np.ones((F, P), dtype=bool)
        visible[12, 3:] = False
        np.savez(tmp_path / "lost.npz", **arrays, visible=visible)
    lost = ("slam", tmp_path / "lost.npz", "--result", tmp_path / "ten.npz", "--live", "10", "--out", tmp_path / "lost")
    ended = connrsfm(*lost)
    assert ended.status == 2
    assert "lost.npz: view 12: it shares fewer than 10 tracks with every keyframe" in ended.err
    assert "give odometry, or leave the view out" in ended.err
    ended = connrsfm(*lost, "--odometry", files["odometry.tum"])
    assert ended.status == 0, ended.err
    assert "view 12 shows too little of the surface" in ended.out
    for more, message in (
        (("--live", "2"), "--live is 2, expected 3 to 15"),
        (("--live", "11"), "holds 10 images and 30 points, expected"),
    ):
        ended = connrsfm(*given, *more, "--out", tmp_path / "other")
        assert ended.status == 2
        assert message in ended.err
        assert "Traceback" not in ended.err


def test_more_views_than_can_be_estimated_together_are_taken_in_one_by_one(
    connrsfm, files, scene, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys.modules[Fused.__module__], "MOST_VIEWS", F - 1)
    given = ("slam", files["tracks.npz"], "--result", files["result.npz"], "--odometry", files["odometry.tum"])
    ended = connrsfm(*given, "--out", tmp_path / "out")
    assert ended.status == 0, ended.err
    _, poses = read_tum(tmp_path / "out" / "trajectory.tum")
    _, odometry = read_tum(files["odometry.tum"])
    assert trajectory_error(poses, scene.poses).ate < trajectory_error(odometry, scene.poses).ate


def test_reconstructs_where_no_result_is_given(connrsfm, files, tmp_path):
    ended = connrsfm("slam", files["tracks.npz"], "--out", tmp_path / "out", "--odometry", files["odometry.tum"])
    assert ended.status == 0, ended.err


def test_bad_input_is_one_sentence_and_writes_nothing(connrsfm, files, tmp_path):
    out = tmp_path / "out"
    short = tmp_path / "short.tum"
    short.write_text("0 0 0 0 0 0 0 1\n")
    with np.load(files["tracks.npz"]) as arrays:
        np.savez(tmp_path / "far.npz", **arrays, camera="orthographic")
    ended = connrsfm("slam", tmp_path / "far.npz", "--out", out)
    assert ended.status == 2
    assert "far.npz: seen by an orthographic camera" in ended.err
    with np.load(files["background.npz"]) as arrays:
        np.savez(tmp_path / "few.npz", tracks=arrays["tracks"][:7], K=arrays["K"])
    given = ("slam", files["tracks.npz"], "--result", files["result.npz"], "--out", out)
    for more, message in (
        (("--background", tmp_path / "few.npz"), "few.npz: holds 7 images, expected one per view, 15"),
        (("--odometry", short), "short.tum: holds 1 poses, expected one per view, 15"),
        (("--odometry", tmp_path / "none.tum"), "none.tum: no such file"),
        (("--odometry-rotation", "-1"), "odometry_rotation_deg is -1.0, expected a positive number"),
    ):
        ended = connrsfm(*given, *more)
        assert ended.status == 2
        assert message in ended.err
        assert "Traceback" not in ended.err
    assert not out.exists()
