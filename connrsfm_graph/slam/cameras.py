"""What is known about the cameras, as native GTSAM factors: odometry, known poses, rigid landmarks; and where to start."""

from __future__ import annotations

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam.assemble import pose_key
from connrsfm_graph.slam.sightings import Sightings
from factors.keys import RIGID_LANDMARK, VIEW_SCALE, key

_FEWEST = 4
"""Shared points from which the motion between two views is taken from the surface."""
_DISTANCE_WEIGHT = 1e-3
"""Weight of the guess of a landmark's place against the rays that see it."""
LANDMARK_HUBER = 3.0
"""Landmarks beyond this many standard deviations of the image noise count linearly."""


def add_odometry(graph: gtsam.NonlinearFactorGraph, steps: np.ndarray, sigmas: np.ndarray) -> None:
    """Steps between neighbouring views.

    Args:
        graph: extended in place.
        steps: (F-1, 4, 4) pose of view j+1 in the camera frame of view j.
        sigmas: (F-1, 6) standard deviations: rotation about x, y, z in radians, then translation.
    """
    for view, (step, sigma) in enumerate(zip(steps, sigmas, strict=True)):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
        graph.add(gtsam.BetweenFactorPose3(pose_key(view), pose_key(view + 1), gtsam.Pose3(step), noise))


def add_known_poses(graph: gtsam.NonlinearFactorGraph, poses: np.ndarray, sigmas: np.ndarray) -> None:
    """Priors on the poses (F, 4, 4), camera to world, with standard deviations (6,) as in `add_odometry`."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    for view, pose in enumerate(poses):
        graph.add(gtsam.PriorFactorPose3(pose_key(view), gtsam.Pose3(pose), noise))


def add_background(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    image: np.ndarray,
    visible: np.ndarray,
    sigma: float,
    distance: float,
) -> int:
    """Landmarks that do not move, by GTSAM's projection factors; those seen once are left out.

    Args:
        graph, values: extended in place; the poses of all views must be among the values.
        image: (F, B, 2) normalised image coordinates, any value where not visible.
        visible: (F, B) bool.
        sigma: noise of a coordinate, normalised coordinates.
        distance: rough distance of the scene, for a start where the rays do not tell.

    Returns:
        Number of landmarks added.
    """
    camera = gtsam.Cal3_S2()
    loss = gtsam.noiseModel.mEstimator.Huber.Create(LANDMARK_HUBER)
    noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
    usable = np.flatnonzero(visible.sum(axis=0) >= 2)
    for landmark in usable.tolist():
        views = np.flatnonzero(visible[:, landmark]).tolist()
        poses = [values.atPose3(pose_key(view)) for view in views]
        m = key(RIGID_LANDMARK, landmark)
        values.insert(m, nearest_point(poses, image[views, landmark], distance))
        for view in views:
            graph.add(gtsam.GenericProjectionFactorCal3_S2(image[view, landmark], noise, pose_key(view), m, camera))
    return len(usable)


def nearest_point(poses: list[gtsam.Pose3], image: np.ndarray, distance: float) -> np.ndarray:
    """Point (3,) nearest to sight rays (N, 2) in the least-squares sense, drawn to `distance` along the first.

    Where the answer is behind the first camera, the guess itself.
    """
    rays = [pose.rotation().matrix() @ np.array([*x, 1.0]) for pose, x in zip(poses, image, strict=True)]
    guess = poses[0].translation() + distance * rays[0]
    A, y = _DISTANCE_WEIGHT * np.eye(3), _DISTANCE_WEIGHT * guess
    for pose, ray in zip(poses, rays, strict=True):
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        A = A + across
        y = y + across @ pose.translation()
    point = np.linalg.solve(A, y)
    return point if poses[0].transformTo(point)[2] > 0.1 * distance else guess


def start_cameras(
    sightings: Sightings, steps: np.ndarray | None = None, first: np.ndarray | None = None
) -> gtsam.Values:
    """Poses and scales to start from: every view fitted to the one before as if the surface were rigid.

    Odometry gives the unit of length (the median ratio of its steps to the fitted ones) and the steps of views that
    share fewer than four points with the view before.

    Args:
        sightings: the reconstruction.
        steps: (F-1, 4, 4) odometry, or None.
        first: (4, 4) pose of the first view; the origin of the world where None.

    Raises:
        InputError: neighbouring views share fewer than four points and there is no odometry.
    """
    points = sightings.points()
    fitted: list[tuple[float, np.ndarray] | None] = []
    for a in range(sightings.n_views - 1):
        shared = sightings.seen[a] & sightings.seen[a + 1]
        if shared.sum() >= _FEWEST:
            scale, R, t = align_similarity(points[a + 1, shared], points[a, shared])
            fitted.append((scale, np.block([[R, t[:, None]], [np.zeros(3), 1.0]])))
        elif steps is not None:
            fitted.append(None)
        else:
            raise InputError(
                f"views {a} and {a + 1} share {shared.sum()} points, expected {_FEWEST}; give odometry, or leave one out"
            )
    unit = 1.0
    if steps is not None:
        pairs = [(steps[a, :3, 3], fit[1][:3, 3]) for a, fit in enumerate(fitted) if fit is not None]
        ratios = [np.linalg.norm(x) / np.linalg.norm(y) for x, y in pairs if np.linalg.norm(y) > 0]
        unit = float(np.median(ratios)) if ratios and np.median(ratios) > 0 else 1.0
    values = gtsam.Values()
    pose, log_scale = np.eye(4) if first is None else np.asarray(first, dtype=float), np.log(unit)
    for view in range(sightings.n_views):
        values.insert(pose_key(view), gtsam.Pose3(pose))
        values.insert(key(VIEW_SCALE, 0, view), np.array([log_scale]))
        if view == len(fitted):
            break
        fit = fitted[view]
        if fit is None:
            assert steps is not None
            step = steps[view]
        else:
            ratio, step = fit
            step = step.copy()
            step[:3, 3] *= np.exp(log_scale)
            log_scale += np.log(ratio)
        pose = pose @ step
    return values
