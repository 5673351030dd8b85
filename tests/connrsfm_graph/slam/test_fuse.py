"""Batch fusion: the same minimum as the plain graph, calibrated, and better than either of its sources."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam import (
    FusionConfig,
    FusionNoise,
    MapModel,
    Sightings,
    SlamConfig,
    add_reconstruction,
    estimate_noise,
    fuse,
    pose_key,
    pose_problem,
    solve_problem,
    trajectory_error,
)
from connrsfm_graph.slam.cameras import add_known_poses, common_scale, nearest_point
from connrsfm_graph.slam.elimination import MapTerms
from connrsfm_graph.slam.fuse import GAUGE_SIGMA
from connrsfm_graph.slam.minimise import Columns, camera_arrays, damped_step
from connrsfm_graph.slam.trajectory import chained, steps_between
from connrsfm_graph.solvers.gtsam_backend import damped, levenberg_marquardt
from connrsfm_graph.solvers.interface import Levenberg
from connrsfm_graph.synthetic.passing_camera import noisy_odometry, passing_camera
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


def drifting_sheet(F=20):
    """A camera that passes before a wall; a stiff sheet between them drifts across its path, ever faster."""
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (F, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 1.5, F)
    sheet = np.column_stack([rng.uniform(-0.6, 0.6, (30, 2)), 3.0 + 0.3 * rng.normal(size=30)])
    points = sheet + np.outer(0.3 * np.linspace(0.0, 1.0, F) ** 2, [0.0, 1.0, 0.0])[:, None]
    wall = np.column_stack([rng.uniform(-2, 3.5, 40), rng.uniform(-2, 2, 40), rng.uniform(4, 6, 40)])
    x, w = points - poses[:, None, :3, 3], wall - poses[:, None, :3, 3]
    sightings = Sightings.checked(x[..., :2] / x[..., 2:], np.log(x[..., 2] / 3.0), np.ones((F, 30), dtype=bool))
    return poses, points, sightings, (w[..., :2] / w[..., 2:], np.ones((F, 40), dtype=bool))


STIFF = FusionNoise(image=1e-3, depth=0.01, motion=0.02, scale=0.01)


def drift(fused):
    return (fused.points[-1] - fused.points[0]).mean(axis=0)


def test_gauge_of_images_alone_the_surface_rests_and_the_camera_does_all_the_moving():
    poses, points, sightings, _ = drifting_sheet()
    fused = solve_problem(pose_problem(sightings, noise=STIFF))
    np.testing.assert_allclose(drift(fused), 0.0, atol=1e-9)
    relative = poses[-1, :3, 3] - (points[-1] - points[0]).mean(axis=0)
    # In the unit of the first view's reconstruction, a third of the world's.
    np.testing.assert_allclose(fused.poses[-1, :3, 3], relative / 3.0, atol=1e-6)


@pytest.mark.parametrize(("with_background", "low", "high"), [(False, 0.0, 0.1), (True, 0.29, 0.31)])
def test_gauge_deformation_is_least_until_a_rigid_background_decides(with_background, low, high):
    """Odometry of good length and bad direction: the drift of 0.3 is told from the camera's by the wall alone."""
    poses, _, sightings, background = drifting_sheet()
    steps, _ = noisy_odometry(poses, translation=0.02, rotation_deg=5.0, seed=1)
    config = SlamConfig(odometry_rotation_deg=5.0)
    fused = solve_problem(pose_problem(sightings, config, STIFF, steps, background if with_background else None))
    assert low < drift(fused)[1] < high


def test_gauge_a_surface_that_moves_in_proportion_to_the_camera_is_a_larger_one_at_rest():
    """No background can tell: half as fast as the camera at distance 3 is at rest at distance 6."""
    poses, points, _, background = drifting_sheet()
    points = points[:1] + 0.5 * poses[:, None, :3, 3]
    x = points - poses[:, None, :3, 3]
    sightings = Sightings.checked(x[..., :2] / x[..., 2:], np.log(x[..., 2] / 3.0), np.ones(x.shape[:2], dtype=bool))
    fused = solve_problem(pose_problem(sightings, noise=STIFF, steps=steps_between(poses), background=background))
    np.testing.assert_allclose(drift(fused), 0.0, atol=1e-3)
    np.testing.assert_allclose(np.exp(fused.log_scale), 6.0, rtol=0.01)


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


def test_sightings_refuse_what_is_not_a_number():
    image, log_depth, seen = np.zeros((2, 3, 2)), np.zeros((2, 3)), np.ones((2, 3), dtype=bool)
    log_depth[1, 2] = np.nan
    with pytest.raises(InputError, match="point 2 of view 1 is not a finite"):
        Sightings.checked(image, log_depth, seen)
    seen[1, 2] = False
    assert Sightings.checked(image, log_depth, seen).log_depth[1, 2] == 0.0


def test_noise_levels_are_found_from_the_views_alone():
    """Depth noise to a fifth; motion to a factor of two: it is read across the rays, the sheet waves along them."""
    case = posed(n_frames=60, n_points=60, gaps=0.0, seed=2)
    noise = estimate_noise(case.sightings, 1e-3)
    unit = np.exp(np.mean(np.log(case.scene.depth()) - case.sightings.log_depth))
    motion = np.sqrt((np.diff(case.scene.points, axis=0) ** 2).mean()) / unit
    assert noise.depth == pytest.approx(0.02, rel=0.2)
    assert 0.5 < noise.motion / motion < 2.0


def test_depths_that_state_their_noise_leave_their_change_to_motion():
    """Errors that neighbouring views share do not show in the views' differences; motion along the rays does."""
    case = posed(n_frames=60, n_points=60, gaps=0.0, seed=2)
    bias = 0.02 * np.random.default_rng(0).normal(size=60)
    sightings = Sightings.checked(
        case.scene.image, np.log(case.scene.depth()) + bias, case.scene.visible, np.full((60, 60), 0.02)
    )
    noise = estimate_noise(sightings, 1e-3)
    assert noise.depth == pytest.approx(0.02)
    motion = np.sqrt((np.diff(case.scene.points, axis=0) ** 2).mean())
    assert 0.7 < noise.motion / motion < 1.5


def test_common_scale_and_nearest_point():
    scene = passing_camera(20, 30, 5, swing=0.0)
    rigid = Sightings.checked(scene.image, np.log(scene.depth() / 7.0), scene.visible)
    assert common_scale(rigid, scene.poses, NOISE, 1e-3) == pytest.approx(np.log(7.0), abs=0.01)
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])) for x in (-1.0, 0.0, 1.0)]
    point = np.array([0.2, 0.1, 4.0])
    image = np.array([pose.transformTo(point)[:2] / pose.transformTo(point)[2] for pose in poses])
    np.testing.assert_allclose(nearest_point(poses, image, 4.0), point, atol=1e-9)
