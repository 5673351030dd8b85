"""What is known about the cameras, as native GTSAM factors (odometry, known poses, rigid landmarks), and a start."""

from __future__ import annotations

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam.assemble import pose_key
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.slam.sightings import Sightings
from factors.keys import RIGID_LANDMARK, VIEW_SCALE, key

_FEWEST = 4
"""Shared points from which the pose of a view is taken from the surface."""
_RENEWAL = 0.1
"""Share of the newest view in the running mean of the surface."""
_GUESS_WEIGHT = 1.0
"""Weight of the guess of a landmark's place, in rays. Poses from odometry turn too much for their rays to be trusted:
a start behind a camera has no way out, one at a wrong distance has."""
STANDSTILL = 1e-9
"""Length up to which a step of odometry is none."""
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
    usable = np.flatnonzero(visible.sum(axis=0) >= 2)
    for landmark in usable.tolist():
        views = np.flatnonzero(visible[:, landmark]).tolist()
        poses = [values.atPose3(pose_key(view)) for view in views]
        m = key(RIGID_LANDMARK, landmark)
        values.insert(m, nearest_point(poses, image[views, landmark], distance))
        for view in views:
            graph.add(landmark_factor(landmark, view, image[view, landmark], sigma))
    return len(usable)


def landmark_factor(landmark: int, view: int, image: np.ndarray, sigma: float) -> gtsam.NonlinearFactor:
    """Projection of a rigid landmark to an image point (2,), both coordinates with noise `sigma`, normalised."""
    loss = gtsam.noiseModel.mEstimator.Huber.Create(LANDMARK_HUBER)
    noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
    m = key(RIGID_LANDMARK, landmark)
    return gtsam.GenericProjectionFactorCal3_S2(image, noise, pose_key(view), m, gtsam.Cal3_S2())


def nearest_point(poses: list[gtsam.Pose3], image: np.ndarray, distance: float) -> np.ndarray:
    """Point (3,) nearest to sight rays (N, 2) in the least-squares sense, drawn to `distance` along the first.

    Where the answer is behind the first camera, the guess itself.
    """
    rays = [pose.rotation().matrix() @ np.array([*x, 1.0]) for pose, x in zip(poses, image, strict=True)]
    guess = poses[0].translation() + distance * rays[0]
    A, y = _GUESS_WEIGHT * np.eye(3), _GUESS_WEIGHT * guess
    for pose, ray in zip(poses, rays, strict=True):
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        A = A + across
        y = y + across @ pose.translation()
    point = np.linalg.solve(A, y)
    return point if poses[0].transformTo(point)[2] > 0.1 * distance else guess


def start_cameras(
    sightings: Sightings,
    noise: FusionNoise,
    steps: np.ndarray | None = None,
    sigmas: np.ndarray | None = None,
    first: np.ndarray | None = None,
) -> gtsam.Values:
    """Poses and scales of all views to start from.

    With odometry its steps are chained and one scale for all views is found (`common_scale`). Without, every view is
    fitted as if it were rigid onto the running mean of where the views before put its points.

    Args:
        sightings, noise: the reconstruction.
        steps, sigmas: odometry as in `add_odometry`, or None.
        first: (4, 4) pose of the first view; the origin of the world where None.

    Raises:
        InputError: there is no odometry and a view shares fewer than four points with those before.
    """
    poses = np.tile(np.eye(4) if first is None else np.asarray(first, dtype=float), (sightings.n_views, 1, 1))
    if steps is None or sigmas is None or not len(steps):
        log_scale = _chain_by_surface(sightings, poses)
    else:
        for view, step in enumerate(steps):
            poses[view + 1] = poses[view] @ step
        drift = float(np.sqrt((sigmas[:, :3] ** 2).mean()))
        log_scale = np.full(len(poses), common_scale(sightings, poses, noise, drift))
    values = gtsam.Values()
    for view, pose in enumerate(poses):
        values.insert(pose_key(view), gtsam.Pose3(pose))
        values.insert(key(VIEW_SCALE, 0, view), log_scale[view : view + 1])
    return values


def common_scale(sightings: Sightings, poses: np.ndarray, noise: FusionNoise, drift: float) -> float:
    """Log scale, the same for all views, at which the surface moves least in the world.

    Between views a and b at some distance in time a point moves by X_b - X_a + (t_b - t_a) / s in units of the
    reconstruction (X along the axes of the world). That is linear in 1 / s and in the error of the rotation between
    the views, which is estimated too.

    Args:
        sightings, noise: the reconstruction.
        poses: (F, 4, 4).
        drift: standard deviation of the poses' rotation error per view, radians; it grows with the root of time.

    Returns:
        log s; 0 where the camera does not move far enough to tell.
    """
    F = sightings.n_views
    lag = max(1, F // 4)
    points = np.einsum("fij,fpj->fpi", poses[:, :3, :3], sightings.points())
    distance = float(np.median(points[sightings.seen] ** 2) ** 0.5)
    information = max(drift * lag**0.5, 1e-9) ** -2.0 * (lag * noise.motion**2 + 2.0 * (noise.depth * distance) ** 2)
    across, along = 0.0, 0.0
    for a in range(F - lag):
        shared = sightings.seen[a] & sightings.seen[a + lag]
        source, target = points[a, shared], points[a + lag, shared]
        if not shared.any():
            continue
        turn = np.concatenate([_cross(x) for x in target])
        moved = (target - source).ravel()
        baseline = np.tile(poses[a + lag, :3, 3] - poses[a, :3, 3], len(target))
        normal = turn.T @ turn + information * np.eye(3)
        unturned = baseline - turn @ np.linalg.solve(normal, turn.T @ baseline)
        across -= float(unturned @ moved)
        along += float(unturned @ baseline)
    return float(np.log(along / across)) if across > 1e-6 * along > 0.0 else 0.0


def _cross(x: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def _chain_by_surface(sightings: Sightings, poses: np.ndarray) -> np.ndarray:
    """Fill in poses from the first on; returns the log scales (F,)."""
    points = sightings.points()
    log_scale = np.zeros(len(poses))
    mean = np.zeros((sightings.n_points, 3))
    known = np.zeros(sightings.n_points, dtype=bool)
    for view, seen in enumerate(sightings.seen):
        shared = seen & known
        if view and shared.sum() < _FEWEST:
            raise InputError(
                f"view {view} shares {shared.sum()} points with the views before, expected {_FEWEST}; "
                "give odometry, or leave it out"
            )
        if view:
            scale, R, t = align_similarity(points[view, shared], mean[shared])
            poses[view, :3, :3], poses[view, :3, 3], log_scale[view] = R, t, np.log(scale)
        world = np.exp(log_scale[view]) * points[view] @ poses[view, :3, :3].T + poses[view, :3, 3]
        mean = np.where((seen & known)[:, None], mean + _RENEWAL * (world - mean), np.where(seen[:, None], world, mean))
        known |= seen
    return log_scale
