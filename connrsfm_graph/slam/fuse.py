"""Batch fusion: trajectory, scale of every view and a deforming map in one world frame.

Levenberg-Marquardt over all variables by the rule of `solvers.interface`. The map is eliminated in batch
(`elimination`), everything else - odometry, priors, rigid landmarks, factors of the user - is a GTSAM graph that GTSAM
linearises. Both together are the graph of `assemble.add_reconstruction`, with the same minimum.

The equations of cameras and other variables are dense, 7 columns per view: made for hundreds of views, and for
landmarks by the hundred.

Gauge: where no factor of one pose alone is given the first pose is held, and where no factor between poses gives a
length the scale of the first view. See `assemble` for what decides between motion of the camera and deformation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.slam.assemble import MapModel, link_scales, pose_key
from connrsfm_graph.slam.elimination import CAMERA, MapState, MapTerms, Reduced
from connrsfm_graph.slam.sightings import FusionNoise, Sightings
from connrsfm_graph.solvers.gtsam_backend import levenberg_marquardt
from connrsfm_graph.solvers.interface import MAX_DAMPING, MIN_DAMPING, Levenberg
from factors.keys import CAMERA_POSE, LOG_DEPTH, MAP_POINT, VIEW_SCALE, decode, describe, key

GAUGE_SIGMA = 1e-6
"""Standard deviation of the priors that fix the gauge."""


@dataclass(frozen=True)
class FusionConfig:
    """Settings of the batch fusion."""

    map: MapModel = field(default_factory=MapModel)
    """How the map moves."""
    levenberg: Levenberg = field(default_factory=lambda: Levenberg(max_iterations=50))
    """Settings of the minimisation."""


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
    """(F, 7, 7) marginal covariance of each camera: rotation and translation in its own frame, log scale."""
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
    settle: bool = True,
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
        settle: minimise over the given factors alone first; not where the cameras start from an estimate with the map.

    Raises:
        InputError: a view sees nothing and no factor holds it, a pose or variable has no start, the graph holds
            variables of the map, or its cost at the start is not a number.
        ComputationError: the normal equations cannot be solved at any damping.
    """
    config = config or FusionConfig()
    rest = _with_gauge(graph, values, sightings, noise)
    cameras = [k for view in range(sightings.n_views) for k in (pose_key(view), key(VIEW_SCALE, 0, view))]
    start = _start_values(rest, values, cameras)
    if settle:  # a landmark that cameras turn away from must not pull at the surface
        start, _, _ = levenberg_marquardt(rest, start, config.levenberg)
    terms = MapTerms(sightings, noise, config.map)
    state = terms.start(*camera_arrays(start, range(sightings.n_views)))
    columns = Columns(rest, start, cameras)
    state, start, history = minimise(terms, state, rest, start, columns, config.levenberg, progress)
    return _fused(terms, sightings, state, start, rest, columns, cameras, history)


def minimise(
    terms: MapTerms,
    state: MapState,
    rest: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    columns: Columns,
    settings: Levenberg,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[MapState, gtsam.Values, list[float]]:
    """Levenberg-Marquardt over the map and the free variables of the rest of the graph.

    Returns:
        Map, values and the costs at the start and after every accepted step.

    Raises:
        InputError: the cost at the start is not a number.
    """
    cost = terms.cost(state) + rest.error(values)
    if not np.isfinite(cost):
        raise InputError("fusion: the cost at the start is not a number; check poses and measurements")
    history, damping = [cost], settings.damping
    while len(history) <= settings.max_iterations:
        hessian, gradient = columns.normal_equations(rest.linearize(values))
        while True:
            try:
                next_state, next_values = _step(terms, state, values, columns, hessian, gradient, damping)
                new = terms.cost(next_state) + rest.error(next_values)
            except (LinAlgError, RuntimeError, ValueError):  # indeterminate, or a residual that is not a number
                new = np.inf
            if new <= cost:
                break
            damping *= 10.0
            if damping > MAX_DAMPING:
                return state, values, history
        decrease, cost, state, values = cost - new, new, next_state, next_values
        history.append(cost)
        damping = max(damping / 10.0, MIN_DAMPING)
        if progress is not None:
            progress(len(history) - 1, settings.max_iterations)
        if decrease <= settings.tolerance * cost:
            break
    return state, values, history


class Columns:
    """Where each variable of the rest of the graph stands: cameras first, seven columns each, then all others."""

    def __init__(
        self,
        rest: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        cameras: list[int],
        held: Collection[int] = (),
    ):
        """Lay out the columns.

        Args:
            rest: the factors.
            values: all their variables, and the cameras.
            cameras: keys of pose and scale of every view of the map, in order.
            held: keys of the variables that do not move.
        """
        zero = values.zeroVectors()
        self.cameras = cameras
        self.n_cameras = CAMERA * (len(cameras) // 2)
        known = set(cameras)
        others = [k for k in values.keys() if k not in known]
        self.start = {k: CAMERA * (n // 2) + 6 * (n % 2) for n, k in enumerate(cameras)}
        self.size = {k: zero.at(k).size for k in values.keys()}
        self.total = self.n_cameras
        for k in others:
            self.start[k], self.total = self.total, self.total + self.size[k]
        ordering = gtsam.Ordering()
        place = []
        for k in rest.keyVector():
            ordering.push_back(k)
            place.append(np.arange(self.start[k], self.start[k] + self.size[k]))
        self.ordering, self.place = ordering, np.concatenate(place)
        free = [np.arange(first, first + self.size[k]) for k, first in self.start.items() if k not in held]
        self.free = np.sort(np.concatenate(free))

    def normal_equations(self, linear: gtsam.GaussianFactorGraph) -> tuple[np.ndarray, np.ndarray]:
        """Hessian and gradient of the rest of the graph over all columns."""
        part, information = linear.hessian(self.ordering)
        hessian, gradient = np.zeros((self.total, self.total)), np.zeros(self.total)
        hessian[np.ix_(self.place, self.place)] = part
        gradient[self.place] = -np.asarray(information).ravel()
        return hessian, gradient

    def vectors(self, step: np.ndarray) -> gtsam.VectorValues:
        """A step as GTSAM takes it."""
        delta = gtsam.VectorValues()
        for k, first in self.start.items():
            delta.insert(k, step[first : first + self.size[k]])
        return delta


def _step(
    terms: MapTerms,
    state: MapState,
    values: gtsam.Values,
    columns: Columns,
    hessian: np.ndarray,
    gradient: np.ndarray,
    damping: float,
) -> tuple[MapState, gtsam.Values]:
    """State and values after one damped Gauss-Newton step."""
    reduced, normal, right = _joined(terms, state, columns, hessian, gradient, damping)
    step = np.zeros(columns.total)
    step[columns.free] = cho_solve(cho_factor(normal, lower=True, overwrite_a=True), -right)
    depths, points = reduced.back_substitute(step[: columns.n_cameras])
    trial = values.retract(columns.vectors(step))
    views = [decode(k)[2] for k in columns.cameras[::2]]
    return MapState(*camera_arrays(trial, views), state.b + depths, state.m + points), trial


def _joined(
    terms: MapTerms, state: MapState, columns: Columns, hessian: np.ndarray, gradient: np.ndarray, damping: float
) -> tuple[Reduced, np.ndarray, np.ndarray]:
    """The normal equations of the free cameras and other variables, the map eliminated."""
    reduced = terms.reduce(state, damping)
    n = columns.n_cameras
    normal, right = hessian + damping * np.eye(columns.total), gradient.copy()
    normal[:n, :n] += reduced.hessian
    right[:n] += reduced.gradient
    return reduced, normal[np.ix_(columns.free, columns.free)], right[columns.free]


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
        lengths |= letters == [CAMERA_POSE] * 2 or letters == [VIEW_SCALE]
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


def camera_arrays(values: gtsam.Values, views: Iterable[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (F, 3, 3), centres (F, 3) and log scales (F,) of some views."""
    cameras = [(values.atPose3(pose_key(view)), values.atVector(key(VIEW_SCALE, 0, view))[0]) for view in views]
    return (
        np.array([pose.rotation().matrix() for pose, _ in cameras]),
        np.array([pose.translation() for pose, _ in cameras]),
        np.array([g for _, g in cameras]),
    )


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
    _, normal, _ = _joined(terms, state, columns, *columns.normal_equations(rest.linearize(values)), 0.0)
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
