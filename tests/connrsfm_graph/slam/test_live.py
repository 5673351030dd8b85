"""Views from tracks, one by one: late, lost and relocalised tracks, and views that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam import LiveFusion, Sightings, fuse_live, trajectory_error
from connrsfm_graph.slam.trajectory import chained
from connrsfm_graph.synthetic.passing_camera import noisy_odometry, passing_camera
from tests.connrsfm_graph.slam.scene import IMAGE_SIGMA, NOISE, sigmas

F, K, P = 30, 20, 50
"""Views, those that are known at the start, points."""


@pytest.fixture(scope="module")
def scene():
    return passing_camera(F, P, 0, seed=2)


@pytest.fixture(scope="module")
def image(scene):
    return scene.image + IMAGE_SIGMA * np.random.default_rng(3).normal(size=scene.image.shape)


def first_views(scene, image, seen):
    """As a good reconstruction gives them, in a unit of its own."""
    log_depth = np.log(scene.depth()[:K]) - 1.0 + 0.002 * np.random.default_rng(4).normal(size=(K, P))
    return Sightings.checked(image[:K], log_depth, seen[:K], np.full((K, P), 0.002))


def surface_error(scene, fusion):
    views = range(fusion.n_views)
    error = [fusion.map_points(view) - scene.points[view, fusion.map.views[view].points] for view in views]
    return float(np.sqrt((np.concatenate(error) ** 2).sum(axis=1).mean()))


def test_late_lost_and_relocalised_tracks(scene, image):
    seen = scene.visible.copy()
    seen[: K + 2, :5] = False  # late: known in no keyframe
    seen[K:, 5:10] = False  # lost
    seen[K - 4 : K + 5, 10:15] = False  # come back
    steps, _ = noisy_odometry(scene.poses, seed=5)
    live = fuse_live(first_views(scene, image, seen), image, seen, None, steps, scene.poses[0])
    assert live.fusion.n_views == F
    poses = np.array([live.fusion.pose(view) for view in range(F)])
    odometry = trajectory_error(chained(steps, scene.poses[0]), scene.poses)
    assert trajectory_error(poses, scene.poses).ate < 0.5 * odometry.ate
    assert surface_error(scene, live.fusion) < 0.1
    late = live.fusion.map.views[-1].points < 5
    assert late.sum() == 5
    error = np.linalg.norm(live.fusion.map_points(F - 1) - scene.points[-1, live.fusion.map.views[-1].points], axis=1)
    assert error[late].max() < 0.2


def test_a_view_that_cannot_be_used_changes_nothing(scene, image):
    steps, _ = noisy_odometry(scene.poses, seed=5)
    odometry = sigmas(steps)
    live = LiveFusion(
        first_views(scene, image, scene.visible), NOISE, steps[: K - 1], odometry[: K - 1], scene.poses[0]
    )
    points, keyframes = np.flatnonzero(scene.visible[K]), len(live.keyframes.views)
    nan = image[K, points].copy()
    nan[2] = np.nan
    for message, bad in (
        ("shares fewer than 10 tracks with every keyframe", (points + 1000, image[K, points])),
        ("point 2 is not a finite", (points, nan)),
        ("six positive standard deviations", (points, image[K, points], steps[K - 1], np.zeros(6))),
    ):
        with pytest.raises(InputError, match=f"view {K}: .*{message}.*the view was not added"):
            live.add(*bad)
    assert (live.fusion.n_views, len(live.keyframes.views)) == (K, keyframes)
    assert live.add(points, image[K, points], steps[K - 1], odometry[K - 1]) == K


@pytest.fixture(scope="module")
def before_background():
    """The scene before a background, with noise in its image points."""
    scene = passing_camera(F, P, 40, seed=2)
    rng = np.random.default_rng(6)
    return scene, scene.background_image + IMAGE_SIGMA * rng.normal(size=scene.background_image.shape)


@pytest.mark.slow
def test_a_rigid_background_holds_the_camera(before_background, image):
    scene, rigid = before_background
    steps, _ = noisy_odometry(scene.poses, seed=5)
    first = first_views(scene, image, scene.visible)
    errors = []
    for background in (None, (rigid, scene.background_visible)):
        live = fuse_live(first, image, scene.visible, None, steps, scene.poses[0], background=background)
        poses = np.array([live.fusion.pose(view) for view in range(F)])
        errors.append(trajectory_error(poses, scene.poses))
    assert errors[1].ate < 0.8 * errors[0].ate
    assert errors[1].rpe_rotation_deg < 0.6 * errors[0].rpe_rotation_deg
    seen_thrice = (scene.background_visible.sum(axis=0) >= 3).sum()
    assert live.fusion.values.size() == 2 * F + seen_thrice
    online, fused = live.fusion.cost(), live.fusion.finish()
    assert fused.others.size() == seen_thrice
    assert online < 1.001 * fused.cost


def test_a_background_that_cannot_be_used_changes_nothing(before_background, image):
    scene, rigid = before_background
    steps, _ = noisy_odometry(scene.poses, seed=5)
    odometry, seen = sigmas(steps), scene.background_visible
    with pytest.raises(InputError, match="background is tracked through 3 views, the points through 30"):
        fuse_live(first_views(scene, image, scene.visible), image, scene.visible, background=(rigid[:3], seen[:3]))

    def started():
        first = first_views(scene, image, scene.visible)
        given = steps[: K - 1], odometry[: K - 1], scene.poses[0]
        return LiveFusion(first, NOISE, *given, background=(rigid, seen))

    live, twin = started(), started()
    points, landmarks = np.flatnonzero(scene.visible[K]), np.flatnonzero(seen[K])
    nan = rigid[K, landmarks].copy()
    nan[1, 0] = np.nan
    for message, bad, step in (
        ("of the background is not a finite image point", (landmarks, nan), odometry[K - 1]),
        ("seen twice", (np.zeros_like(landmarks), rigid[K, landmarks]), odometry[K - 1]),
        ("six positive standard deviations", (landmarks, rigid[K, landmarks]), np.zeros(6)),
    ):
        with pytest.raises(InputError, match=f"view {K}: .*{message}.*the view was not added"):
            live.add(points, image[K, points], steps[K - 1], step, rigid=bad)
    for estimate in (live, twin):
        good = landmarks, rigid[K, landmarks]
        assert estimate.add(points, image[K, points], steps[K - 1], odometry[K - 1], rigid=good) == K
    np.testing.assert_array_equal(live.fusion.pose(K), twin.fusion.pose(K))


def test_a_view_that_shows_too_little_of_the_surface_is_held_by_odometry(scene, image):
    steps, _ = noisy_odometry(scene.poses, seed=5)
    first, seen = first_views(scene, image, scene.visible), scene.visible.copy()
    seen[K + 1, 5:] = False
    live = fuse_live(first, image[: K + 3], seen[: K + 3], None, steps[: K + 2], scene.poses[0])
    assert live.held == [K + 1]
    assert len(live.fusion.map.views[K + 1].points) == 0
    np.testing.assert_allclose(live.fusion.pose(K + 1), live.fusion.pose(K) @ steps[K], atol=0.05)
    with pytest.raises(InputError, match=f"view {K + 1}: it shares fewer than 10 tracks"):
        fuse_live(first, image, seen, pose=scene.poses[0])


def test_an_image_point_that_is_not_a_number_is_no_lack_of_surface(scene, image):
    steps, _ = noisy_odometry(scene.poses, seed=5)
    spoilt = image.copy()
    spoilt[K + 2, np.flatnonzero(scene.visible[K + 2])[0]] = np.nan
    with pytest.raises(InputError, match=f"view {K + 2}: an image point is NaN"):
        fuse_live(first_views(scene, image, scene.visible), spoilt, scene.visible, None, steps)
