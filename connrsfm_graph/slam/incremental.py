"""Incremental fusion with a fixed lag: views arrive one by one, the newest are estimated, older ones are held.

The cost is that of `assemble`. With each view the last `lag` views, their map points and whatever else is tied to them
are minimised over, given the estimates of all before: a point that comes back is tied to where it was last seen, with
a variance that has grown with time. The work per view is bounded, whatever the length of the sequence; `finish` lets
go of everything and ends in the minimum of the batch fusion.

Nothing is stored before a view has been minimised over: whatever is wrong with it, the estimate is as it was before.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam.assemble import MapModel, link_scales, pose_key
from connrsfm_graph.slam.elimination import MapState, MapTerms
from connrsfm_graph.slam.fuse import GAUGE_SIGMA, Columns, Fused, FusionConfig, camera_arrays, fuse, minimise
from connrsfm_graph.slam.sightings import FusionNoise, Sightings, View, stacked
from connrsfm_graph.solvers.interface import Levenberg
from factors.keys import CAMERA_POSE, LOG_DEPTH, MAP_POINT, VIEW_SCALE, decode, describe, key

_FEWEST = 4
"""Points from which the pose of a view without odometry is predicted."""


@dataclass(frozen=True)
class IncrementalConfig:
    """Settings of the incremental fusion."""

    map: MapModel = field(default_factory=MapModel)
    """How the map moves."""
    lag: int = 15
    """Views that are estimated together, the newest included."""
    bootstrap: int = 60
    """Until this many views have come all are estimated together: what is held too early holds a wrong scale."""
    scale_sigma: float = 1.0
    """Standard deviation of the first view's log scale: what is known of the unit before odometry tells."""
    levenberg: Levenberg = field(default_factory=lambda: Levenberg(max_iterations=10, tolerance=1e-3))
    """Settings of the minimisation with every view."""

    def __post_init__(self) -> None:
        if self.lag < 2:
            raise InputError(f"incremental lag is {self.lag}, expected at least 2")

    def first_free(self, number: int) -> int:
        """The oldest view that is estimated together with view `number`."""
        return 0 if number < self.bootstrap else max(0, number - self.lag + 1)


class IncrementalFusion:
    """The growing estimate. Views are numbered in order of arrival, points as the caller numbers them."""

    def __init__(
        self,
        noise: FusionNoise,
        config: IncrementalConfig | None = None,
        first: np.ndarray | None = None,
        log_scale: float = 0.0,
    ):
        """Start empty.

        Args:
            noise: noise levels.
            config: settings.
            first: (4, 4) pose of the first view; the origin of the world where None.
            log_scale: of the first view, to start from.
        """
        self.noise = noise
        self.config = config or IncrementalConfig()
        self.views: list[View] = []
        """What every view saw."""
        self.graph = gtsam.NonlinearFactorGraph()
        """All factors but those of the map and the links between scales."""
        self.values = gtsam.Values()
        """Current estimate of all variables but those of the map."""
        self._first = gtsam.Pose3() if first is None else gtsam.Pose3(first)
        self._log_scale = log_scale
        self._log_depth: list[np.ndarray] = []
        self._points: list[np.ndarray] = []
        self._history: dict[int, list[tuple[int, int]]] = {}  # (view, row) of every sighting of a point
        self._touching: dict[int, list[int]] = {}  # indices in the graph of the factors on a variable

    @property
    def n_views(self) -> int:
        return len(self.views)

    def add_view(
        self,
        view: View,
        step: np.ndarray | None = None,
        sigmas: np.ndarray | None = None,
        factors: gtsam.NonlinearFactorGraph | None = None,
        values: gtsam.Values | None = None,
    ) -> int:
        """Take in the next view.

        Args:
            view: what it saw.
            step, sigmas: odometry from the view before, (4, 4) and (6,) as in `cameras.add_odometry`, or None.
            factors: any further factors on poses, scales and variables of the user, but none on the map.
            values: the start of the variables that these bring.

        Returns:
            Number of the view.

        Raises:
            InputError: the view cannot be used; the message says why and the estimator is as it was before.
        """
        number = self.n_views
        try:
            view = View.checked(view.points, view.image, view.log_depth, view.depth_std)
            pose, scale = self._predicted(view, step)
            new = gtsam.Values()
            new.insert(pose_key(number), pose)
            new.insert(key(VIEW_SCALE, 0, number), np.array([scale]))
            if values is not None:
                taken = [k for k in values.keys() if new.exists(k) or self.values.exists(k)]
                if taken:
                    raise InputError(f"{describe(taken[0])} is there already")
                new.insert(values)
            graph = self._factors(number, pose, scale, step, sigmas)
            if factors is not None:
                graph.push_back(factors)
            trial = gtsam.Values(self.values)
            trial.insert(new)
            _try_out(graph, new, trial)
            window = _Window(self, number, view, trial, graph)
            state, estimate = window.minimised()
        except InputError as error:
            raise InputError(f"view {number}: {error}; the view was not added") from error
        # Nothing can fail from here on.
        trial.update(estimate)
        self.values = trial
        for n in range(graph.size()):
            for k in graph.at(n).keys():
                self._touching.setdefault(k, []).append(self.graph.size() + n)
        self.graph.push_back(graph)
        self.views.append(view)
        self._log_depth.append(np.empty(len(view.points)))
        self._points.append(np.empty((len(view.points), 3)))
        for row, point in enumerate(view.points.tolist()):
            self._history.setdefault(point, []).append((number, row))
        window.store(state)
        return number

    def pose(self, view: int) -> np.ndarray:
        """(4, 4) camera to world, the current estimate."""
        return np.asarray(self.values.atPose3(pose_key(view)).matrix())

    def log_scale(self, view: int) -> float:
        """Current estimate of the log scale of a view."""
        return float(self.values.atVector(key(VIEW_SCALE, 0, view))[0])

    def map_points(self, view: int) -> np.ndarray:
        """(N, 3) current estimate of where the points of a view were."""
        return self._points[view].copy()

    def sightings(self) -> Sightings:
        """What all views saw, points numbered from 0."""
        size = 1 + max((int(view.points.max(initial=-1)) for view in self.views), default=-1)
        return stacked(self.views, [np.arange(len(view.points)) for view in self.views], np.arange(size))

    def finish(self, config: FusionConfig | None = None) -> Fused:
        """The batch fusion of everything so far, from the current estimate."""
        config = config or FusionConfig(map=self.config.map)
        return fuse(self.sightings(), self.noise, self.graph, self.values, config, settle=False)

    def _predicted(self, view: View, step: np.ndarray | None) -> tuple[gtsam.Pose3, float]:
        """Pose and log scale to start a view from: by odometry, or by the map as it was last seen."""
        if not self.views:
            return self._first, self._log_scale
        scale = self.log_scale(self.n_views - 1)
        if step is not None:
            return gtsam.Pose3(self.pose(self.n_views - 1) @ np.asarray(step, dtype=float)), scale
        known = [row for row, point in enumerate(view.points.tolist()) if point in self._history]
        if len(known) < _FEWEST:
            raise InputError(f"it shares {len(known)} points with the map, expected {_FEWEST}, and has no odometry")
        last = [self._history[point][-1] for point in view.points[known].tolist()]
        target = np.array([self._points[number][row] for number, row in last])
        _, R, t = align_similarity(np.exp(scale) * view.camera_points()[known], target)
        return gtsam.Pose3(gtsam.Rot3(R), t), scale

    def _factors(
        self, number: int, pose: gtsam.Pose3, scale: float, step: np.ndarray | None, sigmas: np.ndarray | None
    ) -> gtsam.NonlinearFactorGraph:
        """Gauge of the first view, odometry of every other."""
        graph = gtsam.NonlinearFactorGraph()
        if number == 0:
            held = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
            unit = gtsam.noiseModel.Isotropic.Sigma(1, self.config.scale_sigma)
            graph.add(gtsam.PriorFactorPose3(pose_key(0), pose, held))
            graph.add(gtsam.PriorFactorVector(key(VIEW_SCALE, 0, 0), np.array([scale]), unit))
        if step is not None:
            sigmas = np.zeros(0) if sigmas is None else np.asarray(sigmas, dtype=float)
            if number == 0 or sigmas.shape != (6,) or not (sigmas > 0).all():
                raise InputError("odometry needs a view before it and six positive standard deviations")
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.add(gtsam.BetweenFactorPose3(pose_key(number - 1), pose_key(number), gtsam.Pose3(step), noise))
        return graph


class _Window:
    """The newest views as a problem of their own, with the places before them that their points are tied to."""

    def __init__(
        self,
        fusion: IncrementalFusion,
        number: int,
        newest: View,
        values: gtsam.Values,
        new: gtsam.NonlinearFactorGraph,
    ):
        self.fusion = fusion
        config = fusion.config
        first = config.first_free(number)
        views = [*fusion.views, newest]
        self.points = np.unique(np.concatenate([view.points for view in views[first:]]))
        rows = {n: list(range(len(views[n].points))) for n in range(first, number + 1)}
        for point in self.points.tolist():
            history = fusion._history.get(point, [])
            before = bisect_left(history, (first, 0))
            for n, row in history[max(0, before - config.map.window + 1) : before]:
                rows.setdefault(n, []).append(row)
        self.numbers = sorted(rows)
        self.rows = [np.array(rows[n], dtype=int) for n in self.numbers]
        held = np.array(self.numbers) < first
        sightings = stacked([views[n] for n in self.numbers], self.rows, self.points)
        self.terms = MapTerms(sightings, fusion.noise, config.map, np.array(self.numbers), held)

        free = {k for n in range(first, number + 1) for k in _camera(n)}
        self.graph = self._tied(free, number, new)
        free |= {k for k in self.graph.keyVector() if not _is_camera(k)}
        cameras = [k for n in self.numbers for k in _camera(n)]
        self.values = values.extract(list({*cameras, *self.graph.keyVector()}))
        self.columns = Columns(self.graph, self.values, cameras, {k for k in self.values.keys() if k not in free})

    def minimised(self) -> tuple[MapState, gtsam.Values]:
        """Map and variables after minimisation from the current estimate."""
        terms, fusion = self.terms, self.fusion
        start = terms.start(*camera_arrays(self.values, self.numbers))
        for local, (n, rows) in enumerate(zip(self.numbers, self.rows, strict=True)):
            if n < fusion.n_views:
                mine = self._mine(local)
                order = np.argsort(fusion.views[n].points[rows])
                start.b[mine], start.m[mine] = fusion._log_depth[n][rows[order]], fusion._points[n][rows[order]]
        settings = fusion.config.levenberg
        state, values, _ = minimise(terms, start, self.graph, self.values, self.columns, settings)
        return state, values

    def store(self, state: MapState) -> None:
        """Write the free part of the map back."""
        fusion = self.fusion
        for local, (n, rows) in enumerate(zip(self.numbers, self.rows, strict=True)):
            mine = self._mine(local)
            if self.terms.free[mine].all():
                order = np.argsort(fusion.views[n].points[rows])
                fusion._log_depth[n][rows[order]], fusion._points[n][rows[order]] = state.b[mine], state.m[mine]

    def _mine(self, local: int) -> np.ndarray:
        """Sightings of one view, in order of points."""
        return np.flatnonzero(self.terms.view == local)

    def _tied(self, cameras: set[int], number: int, new: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
        """Factors of the free cameras, and those of the other variables in them from views not long before."""
        fusion = self.fusion
        recent = number - 2 * fusion.config.lag

        def found(keys: set[int]) -> set[int]:
            return {n for k in keys for n in fusion._touching.get(k, [])}

        def last_view(factor: gtsam.NonlinearFactor) -> int:
            return max((decode(k)[2] for k in factor.keys() if _is_camera(k)), default=number)

        direct = found(cameras)
        graph = gtsam.NonlinearFactorGraph()
        for n in range(max(1, fusion.config.first_free(number)), number + 1):
            graph.add(link_scales(n - 1, n, fusion.noise))
        factors = [fusion.graph.at(n) for n in direct] + [new.at(n) for n in range(new.size())]
        others = {k for factor in factors for k in factor.keys() if not _is_camera(k)}
        indirect = [fusion.graph.at(n) for n in sorted(found(others) - direct)]
        for factor in [*factors, *(factor for factor in indirect if last_view(factor) >= recent)]:
            graph.push_back(factor)
        return graph


def _camera(view: int) -> tuple[int, int]:
    return pose_key(view), key(VIEW_SCALE, 0, view)


def _is_camera(k: int) -> bool:
    return decode(k)[0] in (CAMERA_POSE, VIEW_SCALE)


def _try_out(graph: gtsam.NonlinearFactorGraph, new: gtsam.Values, values: gtsam.Values) -> None:
    """Evaluate new factors at the values they would meet, so that a fault is told by name."""
    needed = set(graph.keyVector())
    mapped = [k for k in needed if decode(k)[0] in (LOG_DEPTH, MAP_POINT)]
    if mapped:
        raise InputError(f"a factor is on {describe(mapped[0])}, expected none on the map while it grows")
    missing = [k for k in needed if not values.exists(k)]
    if missing:
        raise InputError(f"a factor asks for {describe(missing[0])}, which has no value")
    idle = [k for k in new.keys() if k not in needed and not _is_camera(k)]
    if idle:
        raise InputError(f"{describe(idle[0])} is in no factor")
    try:
        graph.linearize(values)
        cost = graph.error(values)
    except Exception as error:  # whatever a user's factor throws
        told = str(error).strip().partition("\n")[0][:200]
        raise InputError(f"a factor cannot be evaluated ({type(error).__name__}: {told})") from error
    if not np.isfinite(cost):
        raise InputError("the cost of its factors is not a number")
