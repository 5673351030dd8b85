"""Anchors, scale links and motion of map points: what they are zero at, and what they do not depend on."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.camera_anchor import camera_anchor_factor, linearise_anchors
from factors.jacobian_check import whitened_error
from factors.keys import key
from factors.map_motion import map_motion_factor, motion_coefficients, motion_variance
from factors.scale_link import scale_link_factor
from factors.surface_motion import surface_motion_factor

UNIT = gtsam.noiseModel.Unit.Create(3)


def anchored(point_error, g=0.2, b=-0.3, image=(0.1, -0.2), seed=0):
    rng = np.random.default_rng(seed)
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
    values = gtsam.Values()
    values.insert(key("t", 0, 3), pose)
    values.insert(key("g", 0, 3), np.array([g]))
    values.insert(key("b", 7, 3), np.array([b]))
    x = np.exp(g + b) * (np.array([*image, 1.0]) + point_error)
    values.insert(key("m", 7, 3), pose.transformFrom(x))
    return camera_anchor_factor(7, 3, np.array(image), UNIT), values


def test_anchor_vanishes_where_ray_depth_and_scale_meet_the_map_point():
    factor, values = anchored(np.zeros(3))
    np.testing.assert_allclose(whitened_error(factor, values), 0.0, atol=1e-14)


@pytest.mark.parametrize("g", [-2.0, 0.0, 3.0])
def test_anchor_measures_image_errors_in_normalised_coordinates_at_any_distance(g):
    factor, values = anchored(np.array([0.01, -0.02, 0.0]), g=g)
    assert np.linalg.norm(whitened_error(factor, values)) == pytest.approx(np.hypot(0.01, 0.02), rel=1e-9)


def test_anchor_depends_on_the_sum_of_scale_and_depth_only():
    factor, values = anchored(np.array([0.1, 0.2, 0.3]))
    shifted = gtsam.Values(values)
    shifted.update(key("g", 0, 3), values.atVector(key("g", 0, 3)) + 0.7)
    shifted.update(key("b", 7, 3), values.atVector(key("b", 7, 3)) - 0.7)
    np.testing.assert_allclose(whitened_error(factor, values), whitened_error(factor, shifted), atol=1e-13)


def test_batch_and_factor_are_one_formula():
    factor, values = anchored(np.array([0.1, 0.2, 0.3]))
    pose = values.atPose3(key("t", 0, 3))
    r, J = linearise_anchors(
        pose.rotation().matrix()[None],
        pose.translation()[None],
        np.array([-0.1]),
        np.array([[0.1, -0.2]]),
        values.atPoint3(key("m", 7, 3))[None],
    )
    np.testing.assert_allclose(r[0], whitened_error(factor, values), atol=1e-14)
    np.testing.assert_allclose(J[0], factor.linearize(values).jacobian()[0], atol=1e-14)


def test_anchor_takes_a_pose_of_the_users_own_and_a_map_point_of_another_view():
    factor = camera_anchor_factor(7, 3, np.zeros(2), UNIT, map_view=1, pose_key=gtsam.symbol("x", 3))
    assert list(factor.keys()) == [gtsam.symbol("x", 3), key("g", 0, 3), key("b", 7, 3), key("m", 7, 1)]


def test_motion_vanishes_at_rest_and_change_of_velocity_at_constant_velocity():
    velocity = np.array([0.3, -0.1, 0.2])
    for views, place in (((1, 4), 0.0 * velocity), ((1, 2, 5), velocity)):
        values = gtsam.Values()
        for view in views:
            values.insert(key("m", 2, view), np.ones(3) + view * place)
        values.insert(key("g", 0, 1 if len(views) == 2 else 2), np.array([0.4]))
        np.testing.assert_allclose(whitened_error(map_motion_factor(2, views, 0.1), values), 0.0, atol=1e-14)


def test_motion_is_measured_in_the_reconstructions_unit():
    """Enlarging the world and the views' scales together costs nothing: the prior does not shrink the map."""
    costs = []
    for size in (1.0, 50.0):
        values = gtsam.Values()
        values.insert(key("m", 2, 0), size * np.array([0.1, 0.2, 3.0]))
        values.insert(key("m", 2, 1), size * np.array([0.1, 0.3, 3.1]))
        values.insert(key("g", 0, 0), np.array([np.log(size)]))
        costs.append(map_motion_factor(2, (0, 1), 0.05).error(values))
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def test_variance_grows_with_the_gap():
    np.testing.assert_allclose(motion_variance([[0, 1], [2, 6]]), [1.0, 4.0])
    assert motion_variance((0, 1, 2)) == 1.0


@pytest.mark.parametrize("views", [(1, 4), (1, 2, 5)])
def test_a_surface_moves_as_its_points_do(views):
    """Any number of points: the same cost as point by point, with the map points where the cameras put them."""
    rng = np.random.default_rng(5)
    shapes = rng.normal(size=(len(views), 40, 3))
    values, expected = gtsam.Values(), 0.0
    for view in views:
        values.insert(key("t", 0, view), gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3)))
        values.insert(key("g", 0, view), rng.normal(0.0, 0.3, 1))
    for point in range(40):
        for view, shape in zip(views, shapes, strict=True):
            pose, g = values.atPose3(key("t", 0, view)), values.atVector(key("g", 0, view))[0]
            values.insert(key("m", point, view), pose.transformFrom(np.exp(g) * shape[point]))
        expected += map_motion_factor(point, views, 0.1).error(values)
    factor = surface_motion_factor(views, shapes, 0.1)
    assert factor.error(values) == pytest.approx(expected, rel=1e-10)
    assert factor.dim() == 3 * (3 * len(views) + 1)


@pytest.mark.parametrize("views", [(3,), (3, 2), (1, 1), (0, 1, 2, 3)])
def test_motion_refuses_other_views(views):
    with pytest.raises(ValueError, match="two or three in ascending order"):
        motion_coefficients(views)


def test_scale_link_needs_one_dimension():
    with pytest.raises(ValueError, match="dimension 3, expected 1"):
        scale_link_factor((0, 1), UNIT)
