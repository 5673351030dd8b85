"""Views one by one: equal to batch at the end, bounded work, and no view that cannot be used leaves a trace."""

from __future__ import annotations

import time

import gtsam
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam import (
    FusionConfig,
    IncrementalConfig,
    IncrementalFusion,
    MapModel,
    View,
    pose_key,
    trajectory_error,
)
from connrsfm_graph.slam.trajectory import chained
from connrsfm_graph.solvers.interface import Levenberg
from factors.adapter import make_factor
from factors.keys import RIGID_LANDMARK, key
from tests.connrsfm_graph.slam.scene import NOISE, posed, sigmas

UNIT = gtsam.noiseModel.Unit.Create(1)


def grown(case, n=None, **settings):
    fusion = IncrementalFusion(NOISE, IncrementalConfig(**settings), case.scene.poses[0], log_scale=1.0)
    odometry = sigmas(case.steps)
    for view in range(case.sightings.n_views if n is None else n):
        step = (case.steps[view - 1], odometry[view - 1]) if view else (None, None)
        fusion.add_view(case.sightings.view(view), *step)
    return fusion


@pytest.mark.parametrize("motion", ["position", "velocity"])
def test_with_a_lag_as_long_as_the_sequence_it_is_the_batch(motion):
    case = posed(n_frames=10, n_points=20, gaps=0.2)
    model, tight = MapModel(motion=motion), Levenberg(max_iterations=60, tolerance=1e-10)
    fusion = grown(case, lag=10, map=model, levenberg=tight)
    fused = fusion.finish(FusionConfig(model, tight))
    for view in range(10):
        np.testing.assert_allclose(fusion.pose(view), fused.poses[view], atol=1e-4)
        seen = case.sightings.view(view).points
        np.testing.assert_allclose(fusion.map_points(view), fused.points[view, seen], atol=1e-3)


def test_view_by_view_ends_within_a_thousandth_of_the_batch():
    """Well beyond the lag, with two relaxations on the way; `finish` then goes to the minimum."""
    case = posed(n_frames=50, n_points=20, n_background=0, gaps=0.0)
    fusion = grown(case)
    online = fusion.cost()
    fused = fusion.finish(FusionConfig(levenberg=Levenberg(max_iterations=50, tolerance=1e-8)))
    assert fused.cost_history[0] == pytest.approx(online, rel=1e-9)
    assert fused.cost < online < 1.001 * fused.cost


def test_the_estimate_is_what_finish_starts_from():
    case = posed(n_frames=8, n_points=12, gaps=0.3)
    fusion = grown(case, lag=4)
    estimate = fusion.estimate()
    assert estimate.cost == pytest.approx(fusion.finish().cost_history[0], rel=1e-9)
    np.testing.assert_array_equal(np.isfinite(estimate.points).all(axis=-1), case.sightings.seen)
    np.testing.assert_allclose(estimate.points[5, case.sightings.view(5).points], fusion.map_points(5), rtol=1e-12)
    assert estimate.others.size() == 0


@pytest.mark.parametrize("motion", ["position", "velocity"])
def test_relaxation_moves_cameras_and_keeps_shapes(motion):
    """With the early views held too early the unit is wrong; the relaxation mends most of it."""
    case = posed(n_frames=40, n_points=30, n_background=0, gaps=0.1)
    fusion = grown(case, lag=5, growth=100.0, map=MapModel(motion=motion))
    before, shapes = fusion.cost(), [shape.copy() for shape in fusion.map.shape]
    batch = fusion.finish()
    wrong = abs(np.mean([fusion.log_scale(view) for view in range(40)]) - batch.log_scale.mean())
    fusion.relax()
    relaxed = abs(np.mean([fusion.log_scale(view) for view in range(40)]) - batch.log_scale.mean())
    assert batch.cost < fusion.cost() < before
    assert relaxed < 0.5 * wrong
    for shape, same in zip(shapes, fusion.map.shape, strict=True):
        np.testing.assert_array_equal(shape, same)


def test_late_lost_and_relocalised_tracks_with_a_short_lag():
    case = posed(n_frames=30, n_points=40, gaps=0.4, seed=5)
    seen = case.sightings.seen.copy()
    seen[:10, :10] = False  # late
    seen[20:, 10:20] = False  # lost
    seen[8:24, 20:30] = False  # come back after longer than the lag
    case = type(case)(case.scene, type(case.sightings)(*_with_seen(case.sightings, seen)), case.steps, case.background)
    fusion = grown(case, lag=6)
    poses = np.array([fusion.pose(view) for view in range(30)])
    assert trajectory_error(poses, case.scene.poses).ate < trajectory_error(chained(case.steps), case.scene.poses).ate
    fused = fusion.finish()
    direct = grown(case, lag=30).finish()
    assert fused.cost == pytest.approx(direct.cost, rel=1e-3)


def _with_seen(sightings, seen):
    return (
        np.where(seen[..., None], sightings.image, 0.0),
        seen,
        np.where(seen, sightings.log_depth, 0.0),
        sightings.depth_std,
    )


def test_a_view_that_sees_nothing_is_held_by_odometry():
    case = posed(n_frames=8, n_points=20, gaps=0.0)
    fusion, odometry = grown(case, 5), sigmas(case.steps)
    nothing = View(np.empty(0, dtype=int), np.empty((0, 2)), np.empty(0), np.empty(0))
    fusion.add_view(nothing, case.steps[4], odometry[4])
    np.testing.assert_allclose(fusion.pose(5), fusion.pose(4) @ case.steps[4], atol=1e-3)
    for view in (6, 7):
        fusion.add_view(case.sightings.view(view), case.steps[view - 1], odometry[view - 1])
    fusion.relax()
    assert np.isfinite(fusion.finish().poses).all()


def test_without_odometry_the_surface_carries_the_camera():
    case = posed(n_frames=15, n_points=40, gaps=0.0)
    fusion = IncrementalFusion(NOISE, None, case.scene.poses[0])
    for view in range(15):
        fusion.add_view(case.sightings.view(view))
    poses = np.array([fusion.pose(view) for view in range(15)])
    assert trajectory_error(poses, case.scene.poses, align_scale=True).ate < 0.2


@pytest.mark.slow
def test_work_per_view_does_not_grow():
    """An early and a late view by turns, so that both run on the machine as it is at the time."""
    case = posed(n_frames=90, n_points=20, n_background=0, gaps=0.0)
    odometry = sigmas(case.steps)

    def seconds(fusion: IncrementalFusion) -> float:
        view = fusion.n_views
        started = time.process_time()
        fusion.add_view(case.sightings.view(view), case.steps[view - 1], odometry[view - 1])
        return time.process_time() - started

    early, late = grown(case, 20, lag=8), grown(case, 60, lag=8)
    ratio = [seconds(late) / seconds(early) for _ in range(30)]
    assert np.median(ratio) < 1.5


class _Throws:
    """A user's factor that works so many times."""

    name = "throws"
    rows = 1

    def __init__(self, works=0):
        self.left = works

    def residual(self, pose):
        return self.jacobians(pose)[0]

    def jacobians(self, pose):
        self.left -= 1
        if self.left < 0:
            raise KeyError("a user's mistake")
        return np.ones(1), [np.zeros((1, 6))]


def bad_views(case):
    odometry = sigmas(case.steps)
    view = case.sightings.view(4)
    nan = view.image.copy()
    nan[3, 1] = np.nan
    thrower = gtsam.NonlinearFactorGraph()
    thrower.add(make_factor(_Throws(), [pose_key(4)], [6], UNIT, readers=[gtsam.Values.atPose3]))
    stray = gtsam.NonlinearFactorGraph()
    stray.add(gtsam.PriorFactorVector(key(RIGID_LANDMARK, 9), np.zeros(1), UNIT))
    taken = gtsam.Values()
    taken.insert(pose_key(2), gtsam.Pose3())
    new_points = View(view.points + 1000, view.image, view.log_depth, view.depth_std)
    return {
        "point 3 is not a finite": ((View(np.arange(len(nan)), nan, view.log_depth, view.depth_std),), {}),
        "a point is seen twice": ((View(np.zeros_like(view.points), view.image, view.log_depth, view.depth_std),), {}),
        "shares 0 points with the map": ((new_points,), {}),
        "a user's mistake": ((view,), {"factors": thrower}),
        "rigid landmark of landmark 9, which has no value": ((view,), {"factors": stray}),
        "camera pose of view 2 is there already": ((view,), {"values": taken}),
        "a point has number -1": ((View(view.points - 1, view.image, view.log_depth, view.depth_std),), {}),
        "the cost of its factors is not a number": ((view, np.full((4, 4), np.nan), odometry[3]), {}),
        "six positive standard deviations": ((view, case.steps[3], np.zeros(6)), {}),
    }


def test_a_view_that_cannot_be_used_leaves_the_estimate_as_it_was():
    case = posed(n_frames=6, n_points=20, gaps=0.0)
    fusion, twin = grown(case, 4), grown(case, 4)
    for message, (arguments, more) in bad_views(case).items():
        with pytest.raises(InputError, match=message) as caught:
            fusion.add_view(*arguments, **more)
        assert str(caught.value).startswith("view 4: ")
        assert str(caught.value).endswith("the view was not added")
    assert fusion.n_views == 4
    odometry = sigmas(case.steps)
    for estimate in (fusion, twin):
        for view in (4, 5):
            estimate.add_view(case.sightings.view(view), case.steps[view - 1], odometry[view - 1])
    np.testing.assert_array_equal(fusion.pose(5), twin.pose(5))
    np.testing.assert_array_equal(fusion.map_points(5), twin.map_points(5))


@pytest.mark.parametrize("works", [2, 3, 4])
def test_an_exception_during_the_minimisation_is_passed_on_and_changes_nothing(works):
    case = posed(n_frames=6, n_points=20, gaps=0.0)
    fusion, twin = grown(case, 4), grown(case, 4)
    factors = gtsam.NonlinearFactorGraph()
    factors.add(make_factor(_Throws(works), [pose_key(4)], [6], UNIT, readers=[gtsam.Values.atPose3]))
    odometry = sigmas(case.steps)
    with pytest.raises(KeyError, match="a user's mistake"):
        fusion.add_view(case.sightings.view(4), case.steps[3], odometry[3], factors)
    assert (fusion.n_views, fusion.graph.size()) == (4, twin.graph.size())
    for estimate in (fusion, twin):
        estimate.add_view(case.sightings.view(4), case.steps[3], odometry[3])
    np.testing.assert_array_equal(fusion.pose(4), twin.pose(4))


def test_factors_of_the_user_join_in():
    case = posed(n_frames=4, n_points=20, gaps=0.0)
    fusion = grown(case, 3)
    landmark, m = np.array([0.3, 0.2, 2.0]), key(RIGID_LANDMARK, 0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(m, landmark + 0.1)
    graph.add(gtsam.PriorFactorPoint3(m, landmark, gtsam.noiseModel.Isotropic.Sigma(3, 0.01)))
    pose = gtsam.Pose3(case.scene.poses[3])
    graph.add(gtsam.PriorFactorPose3(pose_key(3), pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)))
    graph.add(gtsam.PriorFactorPoint3(m, landmark + 1.0, gtsam.noiseModel.Isotropic.Sigma(3, 0.01)))
    graph.remove(2)
    fusion.add_view(case.sightings.view(3), factors=graph, values=values)
    np.testing.assert_allclose(fusion.values.atPoint3(m), landmark, atol=1e-6)
    np.testing.assert_allclose(fusion.pose(3), case.scene.poses[3], atol=1e-4)
