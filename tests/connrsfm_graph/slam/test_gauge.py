"""What is motion of the camera and what is deformation: least deformation, unless something else decides."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.slam import FusionNoise, Sightings, SlamConfig, pose_problem, solve_problem
from connrsfm_graph.slam.trajectory import steps_between
from connrsfm_graph.synthetic.passing_camera import noisy_odometry


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
