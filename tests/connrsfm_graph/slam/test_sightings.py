"""What a reconstruction says, how sure it is, and where cameras and landmarks start from."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam import Sightings, add_reconstruction, estimate_noise, pose_key
from connrsfm_graph.slam.cameras import common_scale, nearest_point
from connrsfm_graph.synthetic.passing_camera import passing_camera
from factors.keys import LOG_DEPTH, key
from factors.surface import ORTHOGRAPHIC
from tests.connrsfm_graph.slam.scene import NOISE, posed
from tests.connrsfm_graph.test_reconstruction import small_reconstruction


def test_a_reconstructions_own_deviations_are_those_of_the_depths_in_the_graph():
    """Interpolated points and outliers are left out; what states no deviation gets the common one."""
    made = small_reconstruction()
    depth_std, interpolated, outlier = 0.1 * made.depth, made.interpolated.copy(), made.outlier.copy()
    depth_std[2, 3], interpolated[0, 0], outlier[0, 1] = np.nan, True, True
    made = replace(made, depth_std=depth_std, interpolated=interpolated, outlier=outlier)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for view in range(3):
        values.insert(pose_key(view), gtsam.Pose3())
    add_reconstruction(graph, values, made, NOISE)
    for point, view in ((0, 0), (1, 0), (2, 1)):
        assert not values.exists(key(LOG_DEPTH, point, view))
    priors = {f.keys()[0]: f for f in map(graph.at, range(graph.size())) if isinstance(f, gtsam.PriorFactorVector)}
    for point, view, sigma in ((2, 0, 0.1), (3, 2, NOISE.depth)):
        prior = priors[key(LOG_DEPTH, point, view)]
        assert prior.noiseModel().sigma() == pytest.approx(sigma)
        assert prior.prior()[0] == pytest.approx(np.log(made.depth[view, point]))
    with pytest.raises(InputError, match="orthographic camera"):
        Sightings.of(replace(made, camera=ORTHOGRAPHIC))


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
