"""Trajectories, maps and problems in files."""

from __future__ import annotations

import re

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam import (
    load_problem,
    pose_key,
    pose_problem,
    read_tum,
    save_problem,
    solve_problem,
    trajectory_error,
    write_map,
    write_tum,
)
from connrsfm_graph.slam.drawing import write_drawing
from connrsfm_graph.slam.trajectory import chained, steps_between
from factors.adapter import make_factor
from tests.connrsfm_graph.slam.scene import NOISE, posed

PROJECTION = gtsam.GenericProjectionFactorCal3_S2


def random_poses(n, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(n, 3))
    return poses


def test_tum_round_trip(tmp_path):
    poses, times = random_poses(7), np.linspace(3.0, 4.0, 7)
    write_tum(tmp_path / "t.tum", poses, times)
    again_times, again = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(again, poses, atol=1e-8)
    np.testing.assert_allclose(again_times, times, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nothing\n", "holds no pose"),
        ("0 0 0 0 0 0 0 1\n1 2 3\n", "line 2 is not time x y z"),
        ("0 0 0 0 0 0 0 0\n", "line 1 is not"),
        ("0 0 nan 0 0 0 0 1\n", "line 1 is not"),
        ("0 0 0 0 0 0 0 1\n\n0 1 0 0 0 0 0 1\n", "line 3 is not later"),
    ],
)
def test_bad_trajectories_are_named(tmp_path, text, message):
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_tum(path)


def test_trajectory_error_does_not_see_the_frame_of_the_world():
    truth = random_poses(9)
    np.testing.assert_allclose(chained(steps_between(truth), truth[0]), truth, atol=1e-12)
    frame = random_poses(1, seed=1)[0]
    moved = frame @ truth
    error = trajectory_error(moved, truth)
    assert error.ate < 1e-12
    assert error.rpe_rotation_deg < 1e-5
    moved[:, :3, 3] *= 2.0
    assert trajectory_error(moved, truth).ate > 0.5
    assert trajectory_error(moved, truth, align_scale=True).ate < 1e-12
    assert trajectory_error(moved, truth, align_scale=True).scale == pytest.approx(0.5)


def test_a_loaded_problem_has_the_same_solution(tmp_path):
    case = posed(n_frames=6, n_points=12)
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps, background=case.background)
    save_problem(tmp_path / "problem.npz", problem)
    np.testing.assert_array_equal(
        solve_problem(load_problem(tmp_path / "problem.npz")).poses, solve_problem(problem).poses
    )


class _Measurement:
    name = "mine"
    rows = 1

    def residual(self, pose):
        return np.zeros(1)

    def jacobians(self, pose):
        return np.zeros(1), [np.zeros((1, 6))]


def test_a_problem_with_a_python_factor_is_refused(tmp_path):
    case = posed(n_frames=3, n_points=12)
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps)
    unit = gtsam.noiseModel.Unit.Create(1)
    problem.graph.add(make_factor(_Measurement(), [pose_key(1)], [6], unit, readers=[gtsam.Values.atPose3]))
    with pytest.raises(InputError, match="factor on camera pose of view 1 is written in Python"):
        save_problem(tmp_path / "problem.npz", problem)
    assert not (tmp_path / "problem.npz").exists()


def test_a_file_that_is_no_problem_is_named(tmp_path):
    np.savez(tmp_path / "x.npz", image=np.zeros(3))
    with pytest.raises(InputError, match=r"x\.npz: field 'log_depth' is missing"):
        load_problem(tmp_path / "x.npz")


def test_map_holds_every_point_with_its_view(tmp_path):
    case = posed(n_frames=4, n_points=12)
    fused = solve_problem(pose_problem(case.sightings, noise=NOISE, steps=case.steps))
    for view in (None, 2):
        write_map(tmp_path / "map.ply", fused, view)
        header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
        table = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("view", "<i4"), ("point", "<i4")])
        assert f"element vertex {len(table)}" in header.decode()
        assert len(table) == (case.sightings.seen.sum() if view is None else case.sightings.seen[view].sum())
        np.testing.assert_allclose(table["xyz"], fused.points[table["view"], table["point"]], rtol=1e-5, atol=1e-6)


def nodes_and_edges(path):
    lines = [line.strip() for line in path.read_text().splitlines()]
    edges = [line for line in lines if " -- " in line]
    return [line for line in lines if line.endswith('"];') and line not in edges], edges


def test_the_drawing_counts_every_factor(tmp_path):
    case = posed(n_frames=5, n_points=12, gaps=0.3)
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps, background=case.background)
    write_drawing(tmp_path / "graph.dot", problem)
    nodes, edges = nodes_and_edges(tmp_path / "graph.dot")
    assert len(nodes) == 5 + 5 + 1
    counts = {}
    for edge in edges:
        kind, count = re.search(r'label="(.*): (\d+)"', edge).groups()
        counts[kind] = counts.get(kind, 0) + int(count)
    sightings = int(case.sightings.seen.sum())
    projections = sum(isinstance(problem.graph.at(n), PROJECTION) for n in range(problem.graph.size()))
    ties = sightings - int(case.sightings.seen.any(axis=0).sum())
    assert counts == {
        "anchor": sightings,
        "motion": ties,
        "odometry": 4,
        "projection": projections,
        "scale link": 4,
    }


def test_the_drawing_of_many_views_stays_small(tmp_path):
    case = posed(n_frames=45, n_points=12, gaps=0.5)
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps)
    write_drawing(tmp_path / "graph.dot", problem, most=10)
    nodes, _ = nodes_and_edges(tmp_path / "graph.dot")
    assert len(nodes) == 2 * 9
    assert 'label="views 40 to 44"' in (tmp_path / "graph.dot").read_text()
