"""A reconstruction as factors in a GTSAM graph, one by one: for graphs of one's own, and the reference of the solver.

What camera motion is and what deformation decides the prior on motion. It is isotropic and independent over points,
so of all explanations of the images that differ by a motion of camera and surface together, the one in which the
surface's points move least (in sum of squares) is the cheapest: **minimum deformation**. Every rigid landmark, prior
or odometry factor adds its own cost to that of moving the camera, and a **rigid background decides**: its image points
are known to a fraction of a pixel, the motion prior is worth a few per cent of the depth. It decides what it sees: the
camera's rotation and, as far as there is parallax, its path up to a scale, which takes a length from odometry or a
prior. The distance of the surface stays with minimum deformation: one that moves in proportion to the camera looks
like a larger one at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.slam.noise import FusionNoise, estimate_noise
from connrsfm_graph.slam.sightings import Sightings, View
from factors.camera_anchor import camera_anchor_factor
from factors.keys import CAMERA_POSE, LOG_DEPTH, MAP_POINT, VIEW_SCALE, describe, key
from factors.map_motion import map_motion_factor
from factors.scale_link import scale_link_factor


@dataclass(frozen=True)
class MapModel:
    """How a reconstruction is tied to the world."""

    motion: Literal["position", "velocity"] = "position"
    """What changes little from view to view: the place of a map point, or its velocity."""
    huber: float = 3.0
    """Anchors beyond this many standard deviations of the image noise count linearly."""

    def __post_init__(self) -> None:
        if self.motion not in ("position", "velocity"):
            raise InputError(f"fusion motion is '{self.motion}', expected position or velocity")
        if not self.huber > 0:
            raise InputError(f"fusion huber is {self.huber}, expected a positive number")

    @property
    def window(self) -> int:
        """Sightings of a point that one motion factor spans."""
        return 2 if self.motion == "position" else 3

    def anchor_noise(self, sigma: float) -> gtsam.noiseModel.Base:
        """GTSAM's noise model of an anchor."""
        loss = gtsam.noiseModel.mEstimator.Huber.Create(self.huber)
        return gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(3, sigma))


def pose_key(view: int) -> int:
    """Key of a camera's pose in this package's numbering."""
    return key(CAMERA_POSE, 0, view)


def add_reconstruction(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    reconstruction: Reconstruction | Sightings,
    noise: FusionNoise | None = None,
    model: MapModel | None = None,
    pose_key: Callable[[int], int] = pose_key,
) -> None:
    """Extend a graph by a reconstruction: anchors, depths, motion of the map and links between the views' scales.

    Adds to `values` the log depth and the map point of every sighting, and the log scale of every view that has none
    yet. The camera poses must be there; scales start at 0 unless given. Graph and values stay the caller's, and fit any
    optimiser (drive it as `solvers.gtsam_backend.levenberg_marquardt` does: GTSAM's own copy the values in every call).

    Args:
        graph, values: extended in place, and only if nothing is wrong.
        reconstruction: surfaces in camera frames.
        noise: noise levels; estimated from the reconstruction where None.
        model: how the map moves.
        pose_key: key of the pose (`gtsam.Pose3`, camera to world) of a view.

    Raises:
        InputError: a pose is missing, or a variable is in `values` already.
    """
    sightings = reconstruction if isinstance(reconstruction, Sightings) else Sightings.of(reconstruction)
    noise = noise or estimate_noise(reconstruction)
    model = model or MapModel()
    views = np.flatnonzero(sightings.seen.any(axis=1))
    new_graph, new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for view in views.tolist():
        if not values.exists(pose_key(view)):
            raise InputError(f"view {view}: no {describe(pose_key(view))} among the values; insert a Pose3 for it")
        g = key(VIEW_SCALE, 0, view)
        log_scale = values.atVector(g) if values.exists(g) else np.zeros(1)
        if not values.exists(g):
            new_values.insert(g, log_scale)
        pose = values.atPose3(pose_key(view))
        add_view(
            new_graph, new_values, view, sightings.view(view), pose, pose_key(view), float(log_scale[0]), noise, model
        )
    for point in range(sightings.n_points):
        seen = np.flatnonzero(sightings.seen[:, point])
        for start in range(len(seen) - model.window + 1):
            new_graph.add(map_motion_factor(point, seen[start : start + model.window].tolist(), noise.motion))
    for a, b in zip(views[:-1].tolist(), views[1:].tolist(), strict=True):
        new_graph.add(link_scales(a, b, noise))
    taken = [k for k in new_values.keys() if values.exists(k)]
    if taken:
        raise InputError(f"{describe(taken[0])} is among the values already; a reconstruction is added once")
    graph.push_back(new_graph)
    values.insert(new_values)


def add_view(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    number: int,
    view: View,
    pose: gtsam.Pose3,
    pose_key: int,
    log_scale: float,
    noise: FusionNoise,
    model: MapModel,
) -> None:
    """Anchors and depths of one view, its map points starting where pose, scale and depths put them.

    Args:
        graph, values: extended in place.
        number, view: the view's index in the keys, and what it saw.
        pose, pose_key, log_scale: of the camera, to start from.
        noise, model: as in `add_reconstruction`.
    """
    anchor_noise = model.anchor_noise(noise.image)
    # Not by `pose.transformFrom`, which returns a vector where there is one point.
    world = pose.translation() + np.exp(log_scale) * view.camera_points() @ pose.rotation().matrix().T
    depth_std = np.where(np.isnan(view.depth_std), noise.depth, view.depth_std)
    for n, point in enumerate(view.points.tolist()):
        b, m = key(LOG_DEPTH, point, number), key(MAP_POINT, point, number)
        log_depth = view.log_depth[n : n + 1]
        graph.add(camera_anchor_factor(point, number, view.image[n], anchor_noise, pose_key=pose_key))
        graph.add(gtsam.PriorFactorVector(b, log_depth, gtsam.noiseModel.Isotropic.Sigma(1, depth_std[n])))
        values.insert(b, log_depth)
        values.insert(m, world[n])


def link_scales(a: int, b: int, noise: FusionNoise) -> gtsam.NonlinearFactor:
    """The scales of two views differ by a random walk over the views between them."""
    return scale_link_factor((a, b), gtsam.noiseModel.Isotropic.Sigma(1, noise.scale * (b - a) ** 0.5))
