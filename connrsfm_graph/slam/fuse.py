"""Batch fusion: trajectory, scale of every view and a deforming map in one world frame.

Levenberg-Marquardt over all variables (`minimise`): the map on one side, odometry, priors, rigid landmarks and factors
of the user as a GTSAM graph on the other. Both together are the graph of `assemble.add_reconstruction`, with the same
minimum.

Gauge: where no factor of one pose alone is given the first pose is held, and where no factor between poses gives a
length the scale of the first view. See `assemble` for what decides between motion of the camera and deformation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.slam.assemble import MapModel, link_scales, pose_key
from connrsfm_graph.slam.cameras import STANDSTILL
from connrsfm_graph.slam.elimination import CAMERA, MapState, MapTerms
from connrsfm_graph.slam.minimise import Columns, camera_arrays, joined, minimise
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.slam.sightings import Sightings
from connrsfm_graph.solvers.gtsam_backend import levenberg_marquardt
from connrsfm_graph.solvers.interface import Levenberg
from factors.keys import CAMERA_POSE, LOG_DEPTH, MAP_POINT, VIEW_SCALE, decode, describe, key

GAUGE_SIGMA = 1e-6
"""Standard deviation of the priors that fix the gauge."""
MOST_VIEWS = 1000
"""Views that are estimated together, at most: their dense equations take 2 GiB, which grows with the square."""


@dataclass(frozen=True)
class FusionConfig:
    """Settings of the batch fusion."""

    map: MapModel = field(default_factory=MapModel)
    """How the map moves."""
    levenberg: Levenberg = field(default_factory=lambda: Levenberg(max_iterations=50, tolerance=1e-6))
    """Settings of the minimisation: a trajectory's slowest modes, its drift and scale, hardly change the cost."""


@dataclass(frozen=True)
class Fused:
    """Cameras and map in the world frame."""

    poses: np.ndarray
    """(F, 4, 4) camera to world."""
    log_scale: np.ndarray
    """(F,) log of the world's unit over the reconstruction's, per view."""
    points: np.ndarray
    """(F, P, 3) map points in the world, NaN where not seen."""
    log_depth: np.ndarray
    """(F, P) log depth in the reconstruction's unit, NaN where not seen."""
    camera_covariance: np.ndarray
    """(F, 7, 7) marginal covariance of each camera: rotation and translation in its own frame, log scale; NaN where it
    was not computed."""
    others: gtsam.Values
    """Every other variable of the given graph, such as rigid landmarks."""
    cost: float
    """Final cost."""
    cost_history: tuple[float, ...]
    """Cost at the start and after every accepted step."""

    def values(self) -> gtsam.Values:
        """All variables by key, as in the graph of `assemble.add_reconstruction`."""
        values = gtsam.Values(self.others)
        for view, pose in enumerate(self.poses):
            values.insert(pose_key(view), gtsam.Pose3(pose))
            values.insert(key(VIEW_SCALE, 0, view), self.log_scale[view : view + 1])
        for view, point in np.argwhere(np.isfinite(self.log_depth)).tolist():
            values.insert(key(LOG_DEPTH, point, view), self.log_depth[view, point : point + 1])
            values.insert(key(MAP_POINT, point, view), self.points[view, point])
        return values


def fuse(
    sightings: Sightings,
    noise: FusionNoise,
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    config: FusionConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
    estimate: tuple[np.ndarray, np.ndarray] | None = None,
) -> Fused:
    """Fuse a reconstruction with what is known about the cameras.

    Args:
        sightings: the reconstruction.
        noise: noise levels (`sightings.estimate_noise`).
        graph: everything else, over poses `t(view)`, scales `g(view)` and any other variables but those of the map;
            may be empty. Not changed.
        values: start of the poses of all views and of the graph's other variables; scales start at 0 unless given.
        config: settings.
        progress: called with (accepted steps, most steps).
        estimate: log depths (F, P) and map points (F, P, 3) to start from, where `values` belong to them; else the
            cameras start at the minimum of the given factors alone and the map from the measured depths.

    Raises:
        InputError: there are more than `MOST_VIEWS` views, a view sees nothing and no factor holds it, a pose or
            variable has no start, the graph holds variables of the map, or its cost at the start is not a number.
        ComputationError: the normal equations cannot be solved at any damping.
    """
    config = config or FusionConfig()
    if sightings.n_views > MOST_VIEWS:
        raise InputError(
            f"fusion: {sightings.n_views} views are too many to be estimated together, expected up to {MOST_VIEWS}; "
            "take them in one by one with IncrementalFusion"
        )
    rest = _with_gauge(graph, values, sightings, noise)
    cameras = [k for view in range(sightings.n_views) for k in (pose_key(view), key(VIEW_SCALE, 0, view))]
    start = _start_values(rest, values, cameras)
    terms = MapTerms(sightings, noise, config.map)
    if estimate is None:  # a landmark that cameras turn away from must not pull at the surface
        start, _, _ = levenberg_marquardt(rest, start, config.levenberg)
        state = terms.start(*camera_arrays(start, range(sightings.n_views)))
    else:
        log_depth, points = (array[terms.view, terms.point] for array in estimate)
        state = MapState(*camera_arrays(start, range(sightings.n_views)), log_depth, points)
    columns = Columns(rest, start, cameras)
    state, start, history = minimise(terms, state, rest, start, columns, config.levenberg, progress)
    return _fused(terms, sightings, state, start, rest, columns, cameras, history)


def _with_gauge(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, sightings: Sightings, noise: FusionNoise
) -> gtsam.NonlinearFactorGraph:
    """The given factors, links between the scales of neighbouring views, and the gauge where it is free."""
    rest = gtsam.NonlinearFactorGraph()
    held = lengths = False
    touched = set()
    for n in range(graph.size()):
        factor = graph.at(n)
        if factor is None:
            continue
        letters = [decode(k)[0] for k in factor.keys()]
        if LOG_DEPTH in letters or MAP_POINT in letters:
            raise InputError(f"fusion: a factor on {describe(factor.keys()[0])} is part of the map, which fuse builds")
        held |= letters == [CAMERA_POSE]
        lengths |= letters == [VIEW_SCALE] or (letters == [CAMERA_POSE] * 2 and not _at_rest(factor))
        touched.update(factor.keys())
        rest.push_back(factor)
    blind = [v for v in np.flatnonzero(~sightings.seen.any(axis=1)).tolist() if pose_key(v) not in touched]
    if blind:
        raise InputError(f"fusion: view {blind[0]} sees no point and no factor holds its pose; leave it out")
    for view in range(sightings.n_views - 1):
        rest.add(link_scales(view, view + 1, noise))
    if not held and values.exists(pose_key(0)):
        sigma = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
        rest.add(gtsam.PriorFactorPose3(pose_key(0), values.atPose3(pose_key(0)), sigma))
    if not lengths:
        first = key(VIEW_SCALE, 0, 0)
        scale = values.atVector(first) if values.exists(first) else np.zeros(1)
        rest.add(gtsam.PriorFactorVector(first, scale, gtsam.noiseModel.Isotropic.Sigma(1, GAUGE_SIGMA)))
    return rest


def _at_rest(factor: gtsam.NonlinearFactor) -> bool:
    """Whether a factor is an odometry step of no length, which says nothing about the unit."""
    if not isinstance(factor, gtsam.BetweenFactorPose3):
        return False
    return float(np.linalg.norm(factor.measured().translation())) <= STANDSTILL


def _start_values(rest: gtsam.NonlinearFactorGraph, values: gtsam.Values, cameras: list[int]) -> gtsam.Values:
    """The variables of the rest of the graph and all cameras."""
    start = gtsam.Values(values)
    for k in cameras[1::2]:
        if not start.exists(k):
            start.insert(k, np.zeros(1))
    needed = set(cameras) | set(rest.keyVector())
    missing = sorted(k for k in needed if not start.exists(k))
    if missing:
        raise InputError(f"fusion: {describe(missing[0])} has no start among the values")
    for k in start.keys():
        if k not in needed:
            start.erase(k)
    return start


def _fused(
    terms: MapTerms,
    sightings: Sightings,
    state: MapState,
    values: gtsam.Values,
    rest: gtsam.NonlinearFactorGraph,
    columns: Columns,
    cameras: list[int],
    history: list[float],
) -> Fused:
    _, normal, _ = joined(terms, state, columns, *columns.normal_equations(rest.linearize(values)), 0.0)
    try:
        inverse = cho_solve(cho_factor(normal, lower=True), np.eye(len(normal)))
    except LinAlgError as error:
        raise ComputationError(
            "fusion: poses or scales are not determined; add odometry, a prior, or views that share points"
        ) from error
    F, P = sightings.seen.shape
    poses = np.tile(np.eye(4), (F, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = state.R, state.t
    points, log_depth = np.full((F, P, 3), np.nan), np.full((F, P), np.nan)
    points[terms.view, terms.point], log_depth[terms.view, terms.point] = state.m, state.b
    blocks = [slice(CAMERA * view, CAMERA * (view + 1)) for view in range(F)]
    others = gtsam.Values(values)
    for k in cameras:
        others.erase(k)
    return Fused(
        poses=poses,
        log_scale=state.g,
        points=points,
        log_depth=log_depth,
        camera_covariance=np.array([inverse[block, block] for block in blocks]),
        others=others,
        cost=history[-1],
        cost_history=tuple(history),
    )
