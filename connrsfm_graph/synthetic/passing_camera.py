"""A camera that passes a waving sheet before a rigid background, with the truth of everything in one world frame.

World: x right, y down, z away from the cameras; the sheet waves about the plane z = 0, the background stands behind
it. The sheet never stretches: waves run along it, and its points are integrated along its arc. The camera passes in a
bow at a distance of about 3 with its eyes on the sheet. One time step is one view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from connrsfm_graph.synthetic.placing import HALF_FIELD, SHEET

_ARC_STEPS = 401


@dataclass(frozen=True)
class PassingScene:
    """F views of P points of the sheet and B points of the background. Nothing here has noise."""

    poses: np.ndarray
    """(F, 4, 4) camera to world."""
    points: np.ndarray
    """(F, P, 3) points of the sheet in the world at the time of each view."""
    image: np.ndarray
    """(F, P, 2) normalised image coordinates of the sheet's points."""
    visible: np.ndarray
    """(F, P) bool, in the field of view."""
    background: np.ndarray
    """(B, 3) in the world."""
    background_image: np.ndarray
    """(F, B, 2) normalised image coordinates."""
    background_visible: np.ndarray
    """(F, B) bool."""

    def depth(self) -> np.ndarray:
        """(F, P) depth of the sheet's points along the optical axes."""
        return _in_camera(self.poses, self.points)[..., 2]


def passing_camera(
    n_frames: int = 200,
    n_points: int = 150,
    n_background: int = 60,
    swing: float = 0.5,
    bow_deg: float = 70.0,
    seed: int = 0,
) -> PassingScene:
    """Simulate a scene.

    Args:
        n_frames, n_points, n_background: F, P and B.
        swing: largest slope angle of the waves in radians; 0 gives a rigid sheet.
        bow_deg: angle of the camera's path, seen from the sheet.
        seed: of the points' places.
    """
    rng = np.random.default_rng(seed)
    sheet = rng.uniform(-SHEET, SHEET, (n_points, 2))
    time = np.linspace(0.0, 1.0, n_frames)
    points = np.stack([_waving(sheet, swing, moment * n_frames / 40.0) for moment in time])
    poses = _path(time, np.radians(bow_deg))
    background = np.column_stack(
        [
            rng.uniform(-4.0, 4.0, n_background),
            rng.uniform(-2.5, 2.5, n_background),
            rng.uniform(1.0, 3.0, n_background),
        ]
    )
    image, visible = _seen(poses, points)
    background_image, background_visible = _seen(poses, np.broadcast_to(background, (n_frames, n_background, 3)))
    return PassingScene(poses, points, image, visible, background, background_image, background_visible)


def noisy_odometry(
    poses: np.ndarray, translation: float = 0.02, rotation_deg: float = 1.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Steps from each pose to the next (F-1, 4, 4), in the frame of the first, and standard deviations (F-1, 6).

    Args:
        poses: (F, 4, 4) camera to world.
        translation: standard deviation of each coordinate of a step over the step's length.
        rotation_deg: standard deviation of the rotation about each axis per step.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    angle = np.radians(rotation_deg)
    steps[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_rotvec(angle * rng.normal(size=(len(steps), 3))).as_matrix()
    steps[:, :3, 3] += translation * length * rng.normal(size=(len(steps), 3))
    sigmas = np.concatenate([np.full((len(steps), 3), angle), np.tile(translation * length, 3)], axis=1)
    return steps, sigmas


def relative_depth(
    scene: PassingScene, noise: float = 0.02, bend: float = 0.01, drift: float = 0.005, seed: int = 0
) -> np.ndarray:
    """Log depths (F, P) as a reconstruction without poses gives them: noisy, bent, and in a drifting unit.

    Args:
        scene: the truth.
        noise: standard deviation of each log depth.
        bend: standard deviation of a quadratic error over the image, which keeps 80 % of itself from view to view.
        drift: standard deviation of the change of log scale between neighbouring views.
        seed: of all of it.
    """
    rng = np.random.default_rng(seed)
    F, P = scene.visible.shape
    u, v = np.moveaxis(scene.image / HALF_FIELD, -1, 0)
    error = np.zeros(5)
    log_depth = np.log(scene.depth()) + noise * rng.normal(size=(F, P)) + drift * rng.normal(size=(F, 1)).cumsum(axis=0)
    for f in range(F):
        error = 0.8 * error + 0.6 * bend * rng.normal(size=5)
        log_depth[f] += error @ np.stack([u[f], v[f], u[f] ** 2, u[f] * v[f], v[f] ** 2])
    return log_depth - log_depth[0].mean()


def _waving(sheet: np.ndarray, swing: float, phase: float) -> np.ndarray:
    """Points (P, 3) of the sheet: waves along its length that run one wave per unit of `phase`."""
    arc = np.linspace(-SHEET[0], SHEET[0], _ARC_STEPS)
    slope = swing * np.sin(2.0 * np.pi * (0.7 * arc - phase))
    x, z = (_integral(curve, arc) for curve in (np.cos(slope), np.sin(slope)))
    return np.column_stack([np.interp(sheet[:, 0], arc, x), sheet[:, 1], np.interp(sheet[:, 0], arc, z)])


def _integral(values: np.ndarray, arc: np.ndarray) -> np.ndarray:
    """Antiderivative along the arc, zero on average."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(arc)
    total = np.concatenate([[0.0], steps.cumsum()])
    return total - total.mean()


def _path(time: np.ndarray, bow: float) -> np.ndarray:
    """Poses (F, 4, 4) of a camera that passes in a bow, nods a little and looks at the sheet's middle."""
    angle, distance = bow * (time - 0.5), 3.0 + 0.3 * np.sin(5.0 * time)
    centre = np.column_stack([distance * np.sin(angle), 0.25 * np.sin(7.0 * time), -distance * np.cos(angle)])
    forward = np.column_stack([0.1 * np.sin(9.0 * time), 0.1 * np.cos(11.0 * time), np.zeros_like(time)]) - centre
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    poses[:, :3, 3] = centre
    return poses


def _in_camera(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(F, P, 3) world points (F, P, 3) in the frames of the cameras."""
    return np.einsum("fji,fpj->fpi", poses[:, :3, :3], points - poses[:, None, :3, 3])


def _seen(poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalised image coordinates (F, P, 2), 0 where out of the field of view, and what is in it (F, P)."""
    x = _in_camera(poses, points)
    image = x[..., :2] / np.maximum(x[..., 2:], 1e-9)
    inside = (x[..., 2] > 0) & (np.abs(image) < HALF_FIELD).all(axis=-1)
    return np.where(inside[..., None], image, 0.0), inside
