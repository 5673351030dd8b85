"""Batch fusion: the same minimum as the plain graph, calibrated, and better than either of its sources."""

from __future__ import annotations

import sys

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam import (
    Fused,
    FusionConfig,
    FusionNoise,
    MapModel,
    Sightings,
    add_reconstruction,
    estimate_noise,
    fuse,
    pose_key,
    pose_problem,
    solve_problem,
    trajectory_error,
)
from connrsfm_graph.slam.cameras import add_known_poses
from connrsfm_graph.slam.elimination import MapTerms
from connrsfm_graph.slam.fuse import GAUGE_SIGMA
from connrsfm_graph.slam.minimise import Columns, camera_arrays, damped_step
from connrsfm_graph.slam.trajectory import chained
from connrsfm_graph.solvers.gtsam_backend import damped, levenberg_marquardt
from connrsfm_graph.solvers.interface import Levenberg
from factors.keys import CAMERA_POSE, LOG_DEPTH, MAP_POINT, VIEW_SCALE, decode, describe, key
from tests.connrsfm_graph.slam.scene import NOISE, posed

TIGHT = Levenberg(max_iterations=60, tolerance=1e-10)


def plain_graph(problem, model):
    """Everything as factors one by one, with the gauge that `fuse` would choose."""
    graph, values = gtsam.NonlinearFactorGraph(problem.graph), gtsam.Values(problem.values)
    held = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
    graph.add(gtsam.PriorFactorPose3(pose_key(0), values.atPose3(pose_key(0)), held))
    add_reconstruction(graph, values, problem.sightings, problem.noise, model)
    return graph, values


@pytest.mark.parametrize("motion", ["position", "velocity"])
def test_elimination_reaches_the_minimum_of_the_plain_graph(motion):
    case = posed()
    model = MapModel(motion=motion)
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps, background=case.background)
    fused = fuse(problem.sightings, NOISE, problem.graph, problem.values, FusionConfig(model, TIGHT))
    graph, values = plain_graph(problem, model)
    assert graph.error(fused.values()) == pytest.approx(fused.cost, rel=1e-12)
    reference, cost, _ = levenberg_marquardt(graph, values, TIGHT)
    assert fused.cost == pytest.approx(cost, rel=1e-8)
    for view in range(case.sightings.n_views):
        np.testing.assert_allclose(fused.poses[view], reference.atPose3(pose_key(view)).matrix(), atol=1e-5)
    marginals = gtsam.Marginals(graph, fused.values())
    last = case.sightings.n_views - 1
    covariance = marginals.marginalCovariance(pose_key(last))
    np.testing.assert_allclose(fused.camera_covariance[last][:6, :6], covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("motion", ["position", "velocity"])
def test_one_damped_step_equals_gtsams(motion):
    """Far from the minimum, where Huber's loss and all couplings are at work."""
    case = posed(n_frames=6, n_points=12, gaps=0.3)
    model, damping = MapModel(motion=motion, huber=0.5), 0.1
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps, background=case.background)
    graph, values = plain_graph(problem, model)
    reference = damped(graph.linearize(values), values, damping).optimize()

    rest = gtsam.NonlinearFactorGraph()
    for n in range(graph.size()):
        if not any(decode(k)[0] in (LOG_DEPTH, MAP_POINT) for k in graph.at(n).keys()):
            rest.push_back(graph.at(n))
    columns = Columns(rest, problem.values, [k for v in range(6) for k in (pose_key(v), key(VIEW_SCALE, 0, v))])
    terms = MapTerms(case.sightings, NOISE, model)
    start = terms.start(*camera_arrays(problem.values, range(6)))
    assert terms.cost(start) + rest.error(problem.values) == pytest.approx(graph.error(values), rel=1e-12)
    normal = columns.normal_equations(rest.linearize(problem.values))
    step, depths, points = damped_step(terms, start, columns, *normal, damping)
    delta = columns.vectors(step)
    for k in problem.values.keys():
        np.testing.assert_allclose(delta.at(k), reference.at(k), atol=1e-9)
    for n, (point, view) in enumerate(zip(terms.point.tolist(), terms.view.tolist(), strict=True)):
        assert depths[n] == pytest.approx(reference.at(key(LOG_DEPTH, point, view))[0], abs=1e-9)
        np.testing.assert_allclose(points[n], reference.at(key(MAP_POINT, point, view)), atol=1e-9)


def test_fusion_is_better_than_odometry_and_than_alignment_frame_by_frame():
    case = posed(n_frames=40, n_points=40, n_background=30, seed=4)
    problem = pose_problem(
        case.sightings,
        noise=estimate_noise(case.sightings, 1e-3),
        steps=case.steps,
        background=case.background,
        first=case.scene.poses[0],
    )
    fused = solve_problem(problem)
    odometry = trajectory_error(chained(case.steps), case.scene.poses)
    assert trajectory_error(fused.poses, case.scene.poses).ate < 0.5 * odometry.ate
    seen = case.sightings.seen
    error = np.linalg.norm(fused.points - case.scene.points, axis=-1)[seen]
    oracle = []
    for view, camera_points in enumerate(case.sightings.points()):
        source, target = camera_points[seen[view]], case.scene.points[view, seen[view]]
        scale, R, t = align_similarity(source, target)
        oracle.append(((scale * source @ R.T + t - target) ** 2).sum(axis=1))
    assert np.sqrt((error**2).mean()) < np.sqrt(np.concatenate(oracle).mean())


def model_draw(rng, F=5, P=10):
    """Views, map and measurements drawn from the very model the factors state; the cameras differ from run to run.

    Half of the depths state deviations of their own, as those of a refined reconstruction do.
    """
    noise = FusionNoise(image=2e-3, depth=0.03, motion=0.01, scale=0.02)
    g = np.concatenate([[0.0], noise.scale * rng.normal(size=F - 1)]).cumsum()
    poses = [gtsam.Pose3(gtsam.Rot3.Expmap(0.1 * rng.normal(size=3)), 0.3 * rng.normal(size=3)) for _ in range(F)]
    m = np.empty((F, P, 3))
    m[0] = np.column_stack([rng.uniform(-1, 1, (P, 2)), rng.uniform(2, 4, P)])
    for f in range(1, F):
        m[f] = m[f - 1] + np.exp(g[f - 1]) * noise.motion * rng.normal(size=(P, 3))
    x = np.array([pose.transformTo(points.T).T for pose, points in zip(poses, m, strict=True)])
    stated = np.where(rng.uniform(size=(F, P)) < 0.5, rng.uniform(0.002, 0.1, (F, P)), np.nan)
    deviation = np.where(np.isnan(stated), noise.depth, stated)
    image = x[..., :2] / x[..., 2:] + noise.image * rng.normal(size=(F, P, 2))
    log_depth = np.log(x[..., 2]) - g[:, None] + deviation * rng.normal(size=(F, P))
    return noise, poses, g, m, Sightings.checked(image, log_depth, np.ones((F, P), dtype=bool), stated)


def test_marginal_covariances_are_calibrated():
    """Normalised squared errors of the last camera and of a map point: their means over 200 runs lie in the 95 %
    intervals of chi-squared."""
    rng = np.random.default_rng(7)
    runs, camera, point = 200, 0.0, 0.0
    sigma = np.array([0.02] * 3 + [0.05] * 3)
    model = MapModel(huber=1e6)  # Huber's loss is not the model the measurements were drawn from
    for _ in range(runs):
        noise, poses, g, m, sightings = model_draw(rng)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for view, pose in enumerate(poses):
            values.insert(pose_key(view), pose)
            values.insert(key(VIEW_SCALE, 0, view), g[view : view + 1])
        measured = [pose.retract(sigma * rng.normal(size=6)) for pose in poses]
        add_known_poses(graph, np.array([pose.matrix() for pose in measured]), sigma)
        unit = gtsam.noiseModel.Isotropic.Sigma(1, 0.05)
        graph.add(gtsam.PriorFactorVector(key(VIEW_SCALE, 0, 0), 0.05 * rng.normal(size=1), unit))
        fused = fuse(sightings, noise, graph, values, FusionConfig(model))
        error = np.append(gtsam.Pose3(fused.poses[-1]).localCoordinates(poses[-1]), g[-1] - fused.log_scale[-1])
        camera += error @ np.linalg.solve(fused.camera_covariance[-1], error)
        add_reconstruction(graph, values, sightings, noise, model)
        covariance = gtsam.Marginals(graph, fused.values()).marginalCovariance(key(MAP_POINT, 3, 2))
        error = fused.points[2, 3] - m[2, 3]
        point += error @ np.linalg.solve(covariance, error)
    for total, size in ((camera, 7), (point, 3)):
        low, high = chi2.ppf([0.025, 0.975], size * runs) / runs
        assert low < total / runs < high


def test_a_users_graph_keeps_its_keys_and_its_optimiser():
    case = posed(n_frames=5, n_points=8)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for view, pose in enumerate(case.scene.poses):
        x = gtsam.symbol("x", view)
        values.insert(x, gtsam.Pose3(pose))
        graph.add(gtsam.PriorFactorPose3(x, gtsam.Pose3(pose), gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
    add_reconstruction(graph, values, case.sightings, NOISE, pose_key=lambda view: gtsam.symbol("x", view))
    optimised = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert graph.error(optimised) < 0.1 * graph.error(values)
    assert not any(decode(k)[0] == CAMERA_POSE for k in optimised.keys())
    assert "map point of point 0, view 0" in graph.dot(values, describe)


def test_adding_twice_or_without_poses_is_refused_and_changes_nothing():
    case = posed(n_frames=3, n_points=8)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    with pytest.raises(InputError, match="view 0: no camera pose of view 0 among the values"):
        add_reconstruction(graph, values, case.sightings, NOISE)
    for view, pose in enumerate(case.scene.poses):
        values.insert(pose_key(view), gtsam.Pose3(pose))
    add_reconstruction(graph, values, case.sightings, NOISE)
    size = graph.size(), values.size()
    with pytest.raises(InputError, match="is among the values already"):
        add_reconstruction(graph, values, case.sightings, NOISE)
    assert (graph.size(), values.size()) == size


def test_fuse_names_what_is_missing():
    case = posed(n_frames=3, n_points=8)
    values = gtsam.Values()
    for view in range(2):
        values.insert(pose_key(view), gtsam.Pose3())
    with pytest.raises(InputError, match="camera pose of view 2 has no start"):
        fuse(case.sightings, NOISE, gtsam.NonlinearFactorGraph(), values)
    blind = Sightings.checked(case.sightings.image, case.sightings.log_depth, np.zeros((3, 8), dtype=bool))
    with pytest.raises(InputError, match="view 0 sees no point"):
        fuse(blind, NOISE, gtsam.NonlinearFactorGraph(), values)


@pytest.mark.parametrize(("views", "points"), [(1, 8), (2, 8), (5, 1)])
def test_the_smallest_problems_have_the_minimum_of_the_plain_graph(views, points):
    case = posed(n_frames=5, n_points=8, gaps=0.0)
    some = Sightings.checked(*(array[:views, :points] for array in _arrays(case.sightings)))
    problem = pose_problem(some, noise=NOISE, steps=case.steps[: views - 1])
    fused = fuse(some, NOISE, problem.graph, problem.values, FusionConfig(levenberg=TIGHT))
    graph, _ = plain_graph(problem, MapModel())
    if views == 1:  # without odometry the unit is the reconstruction's, held where it is
        unit = gtsam.noiseModel.Isotropic.Sigma(1, GAUGE_SIGMA)
        graph.add(gtsam.PriorFactorVector(key(VIEW_SCALE, 0, 0), np.zeros(1), unit))
    assert graph.error(fused.values()) == pytest.approx(fused.cost, rel=1e-9, abs=1e-12)


def _arrays(sightings):
    return sightings.image, sightings.log_depth, sightings.seen, sightings.depth_std


def test_nothing_seen_and_too_many_views_are_told(monkeypatch):
    case = posed(n_frames=3, n_points=8)
    problem = pose_problem(case.sightings, noise=NOISE, steps=case.steps)
    monkeypatch.setattr(sys.modules[Fused.__module__], "MOST_VIEWS", 2)
    with pytest.raises(InputError, match="3 views are too many to be estimated together, expected up to 2"):
        solve_problem(problem)
    nothing = Sightings.checked(*(array[:, :0] for array in _arrays(case.sightings)))
    with pytest.raises(InputError, match="no view sees a point"):
        pose_problem(nothing, noise=NOISE, steps=case.steps)
