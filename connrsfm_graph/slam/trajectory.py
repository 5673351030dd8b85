"""Trajectories: TUM files in and out, absolute and relative errors against a truth.

A TUM file has one pose per line, `time x y z qx qy qz qw`, camera to world; lines that start with # are comments.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file, written_beside
from connrsfm_graph.metrics.alignment import align_similarity


def read_tum(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (F,) and poses (F, 4, 4) of a TUM file.

    Raises:
        InputError: the file cannot be read, a line is not eight finite numbers with a quaternion that is not zero, or
            times do not ascend.
    """
    path = Path(path)
    require_file(path)
    rows: list[np.ndarray] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text file, expected lines of time x y z qx qy qz qw") from error
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = np.array([float(word) for word in line.replace(",", " ").split()])
        except ValueError:
            row = np.empty(0)
        if row.shape != (8,) or not np.isfinite(row).all() or not np.linalg.norm(row[4:]) > 0:
            raise InputError(f"{path}: line {number} is not time x y z qx qy qz qw")
        if rows and not row[0] > rows[-1][0]:
            raise InputError(f"{path}: line {number} is not later than the pose before, expected times that ascend")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: holds no pose, expected lines of time x y z qx qy qz qw")
    table = np.array(rows)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return table[:, 0], poses


def write_tum(path: str | Path, poses: np.ndarray, times: np.ndarray | None = None) -> None:
    """Write poses (F, 4, 4), camera to world; times are the numbers of the views where None."""
    times = np.arange(len(poses)) if times is None else times
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    table = np.column_stack([times, poses[:, :3, 3], quaternions])
    with written_beside(path) as part:
        np.savetxt(part, table, fmt="%.9g", header="time x y z qx qy qz qw")


def steps_between(poses: np.ndarray) -> np.ndarray:
    """(F-1, 4, 4) pose of each view in the camera frame of the one before."""
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def chained(steps: np.ndarray, first: np.ndarray | None = None) -> np.ndarray:
    """Poses (F, 4, 4) that steps (F-1, 4, 4) lead to, from `first` or the origin."""
    poses = [np.eye(4) if first is None else np.asarray(first, dtype=float)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of a trajectory against the truth."""

    ate: float
    """Absolute trajectory error: root mean square distance of the camera centres after alignment."""
    rpe_translation: float
    """Relative pose error from view to view: root mean square length of the translational part."""
    rpe_rotation_deg: float
    """Its root mean square angle in degrees."""
    scale: float
    """Scale of the alignment; 1 where the scale was not aligned."""


def trajectory_error(poses: np.ndarray, truth: np.ndarray, align_scale: bool = False) -> TrajectoryError:
    """Errors of poses (F, 4, 4) against the truth (F, 4, 4) after alignment of the centres.

    Args:
        poses, truth: camera to world.
        align_scale: whether the scale is free (no odometry gave it) or not.
    """
    centre, target = poses[:, :3, 3], truth[:, :3, 3]
    scale, R, t = align_similarity(centre, target)
    if not align_scale:
        scale, t = 1.0, target.mean(axis=0) - R @ centre.mean(axis=0)
    distance = np.linalg.norm(scale * centre @ R.T + t - target, axis=1)
    scaled = poses.copy()
    scaled[:, :3, 3] *= scale
    difference = np.linalg.inv(steps_between(truth)) @ steps_between(scaled)
    angle = Rotation.from_matrix(difference[:, :3, :3]).magnitude()
    return TrajectoryError(
        ate=float(np.sqrt((distance**2).mean())),
        rpe_translation=float(np.sqrt((difference[:, :3, 3] ** 2).sum(axis=1).mean())),
        rpe_rotation_deg=float(np.degrees(np.sqrt((angle**2).mean()))),
        scale=float(scale),
    )
