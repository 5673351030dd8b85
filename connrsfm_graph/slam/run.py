"""From a reconstruction and what is known about the cameras to a fused map: the stages in their order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam.cameras import STANDSTILL, add_background, add_odometry, start_cameras
from connrsfm_graph.slam.fuse import Fused, FusionConfig, fuse
from connrsfm_graph.slam.noise import FusionNoise, estimate_noise
from connrsfm_graph.slam.sightings import Sightings
from connrsfm_graph.slam.storage import FusionProblem
from factors.keys import VIEW_SCALE, key


@dataclass(frozen=True)
class SlamConfig:
    """Settings of a fusion from files."""

    fusion: FusionConfig = field(default_factory=FusionConfig)
    """The minimisation."""
    odometry_translation: float = 0.02
    """Standard deviation of a coordinate of an odometry step over the length of the step."""
    odometry_rotation_deg: float = 1.0
    """Standard deviation of an odometry step's rotation about each axis, in degrees."""

    def __post_init__(self) -> None:
        for name in ("odometry_translation", "odometry_rotation_deg"):
            if not getattr(self, name) > 0:
                raise InputError(f"slam {name} is {getattr(self, name)}, expected a positive number")

    def odometry_sigmas(self, steps: np.ndarray) -> np.ndarray:
        """(F-1, 6) standard deviations of odometry steps (F-1, 4, 4).

        A step counts as no shorter than a hundredth of the median step. Odometry that never moves gives no unit of
        length; the reconstruction's then holds, which is about the distance of the surface.
        """
        length = np.linalg.norm(steps[:, :3, 3], axis=1)
        moving = length[length > STANDSTILL]
        least = 0.01 * (float(np.median(moving)) if len(moving) else 1.0)
        turn = np.full((len(steps), 3), np.radians(self.odometry_rotation_deg))
        return np.concatenate(
            [turn, np.tile(self.odometry_translation * np.maximum(length, least)[:, None], 3)], axis=1
        )


def pose_problem(
    sightings: Sightings,
    config: SlamConfig | None = None,
    noise: FusionNoise | None = None,
    steps: np.ndarray | None = None,
    background: tuple[np.ndarray, np.ndarray] | None = None,
    first: np.ndarray | None = None,
) -> FusionProblem:
    """The factors of odometry and background, and a start for all cameras.

    Args:
        sightings: the reconstruction.
        config: settings.
        noise: noise levels; estimated from the reconstruction where None.
        steps: (F-1, 4, 4) odometry, pose of each view in the camera frame of the one before.
        background: image points (F, B, 2), normalised, and visibility (F, B) of points that do not move.
        first: (4, 4) pose of the first view; the origin where None.

    Raises:
        InputError: no view sees a point, numbers of views do not fit, or views share too few points and there is no
            odometry.
    """
    config = config or SlamConfig()
    if not sightings.seen.any():
        raise InputError("fusion: no view sees a point; give a reconstruction with points")
    noise = noise or estimate_noise(sightings)
    F = sightings.n_views
    if steps is not None and len(steps) != F - 1:
        raise InputError(f"odometry has {len(steps) + 1} poses, the reconstruction {F} views")
    if background is not None and len(background[1]) != F:
        raise InputError(f"the background is tracked through {len(background[1])} views, the reconstruction has {F}")
    sigmas = None if steps is None else config.odometry_sigmas(steps)
    graph = gtsam.NonlinearFactorGraph()
    values = start_cameras(sightings, noise, steps, sigmas, first)
    if steps is not None and sigmas is not None:
        add_odometry(graph, steps, sigmas)
    if background is not None:
        depth = float(np.median(np.exp(sightings.log_depth[sightings.seen])))
        distance = depth * float(np.exp(values.atVector(key(VIEW_SCALE, 0, 0))[0]))
        add_background(graph, values, *background, noise.image, distance)
    return FusionProblem(sightings, noise, config.fusion.map, graph, values)


def solve_problem(
    problem: FusionProblem, config: FusionConfig | None = None, progress: Callable[[int, int], None] | None = None
) -> Fused:
    """Fuse a problem, as made here or loaded from a file; its own model of the map holds."""
    config = FusionConfig(problem.model, (config or FusionConfig()).levenberg)
    return fuse(problem.sightings, problem.noise, problem.graph, problem.values, config, progress)
