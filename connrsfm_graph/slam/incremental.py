"""Incremental fusion: views arrive one by one, the newest are estimated, older ones keep their shapes.

The cost is that of `assemble`. With each view the last `lag` views, their map points and whatever else is tied to them
are minimised over, given the estimates of all before (`window`); whenever the sequence has grown by a certain part, all
cameras are relaxed with the shapes given (`relaxation`), which takes time in proportion to the views, but ever more
rarely. The work per view is bounded on average, whatever the length of the sequence. What remains above the minimum is
in the shapes: with the default lag less than 0.1 % of the cost (`experiments.benchmarks.growth` measures it; with rigid
landmarks right after `relax`). `finish` lets go of everything and ends in the minimum of the batch fusion; of sequences
too long for that, `estimate` is final.

Nothing is stored before a view has been minimised over: whatever is wrong with it, the estimate is as it was before.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam.assemble import MapModel, link_scales, pose_key
from connrsfm_graph.slam.elimination import CAMERA, MapState, MapTerms
from connrsfm_graph.slam.fuse import GAUGE_SIGMA, Fused, FusionConfig, fuse
from connrsfm_graph.slam.growing_graph import GrowingGraph, push_back, try_out
from connrsfm_graph.slam.growing_map import GrowingMap
from connrsfm_graph.slam.minimise import camera_arrays
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.slam.relaxation import relaxed
from connrsfm_graph.slam.sightings import Sightings, View
from connrsfm_graph.slam.window import Window, camera_keys
from connrsfm_graph.solvers.interface import Levenberg
from factors.keys import VIEW_SCALE, describe, key

_FEWEST = 4
"""Points from which the pose of a view without odometry is predicted."""


@dataclass(frozen=True)
class IncrementalConfig:
    """Settings of the incremental fusion."""

    map: MapModel = field(default_factory=MapModel)
    """How the map moves."""
    lag: int = 30
    """Views that are estimated together, the newest included."""
    growth: float = 1.2
    """All cameras are relaxed when the views are this many times those of the last relaxation."""
    scale_sigma: float = 1.0
    """Standard deviation of the first view's log scale: what is known of the unit before odometry tells."""
    levenberg: Levenberg = field(default_factory=lambda: Levenberg(max_iterations=10, tolerance=1e-3))
    """Settings of the minimisation with every view."""
    relaxation: Levenberg = field(default_factory=lambda: Levenberg(max_iterations=20, tolerance=1e-6))
    """Settings of the relaxation."""

    def __post_init__(self) -> None:
        if self.lag < 2:
            raise InputError(f"incremental lag is {self.lag}, expected at least 2")
        if not self.growth > 1.0:
            raise InputError(f"incremental growth is {self.growth}, expected more than 1")


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
        self.map = GrowingMap(self.config.map.window)
        """What the views saw and where their points are."""
        self._factors = GrowingGraph()
        self.values = gtsam.Values()
        """Current estimate of all variables but those of the map."""
        self._first = gtsam.Pose3() if first is None else gtsam.Pose3(first)
        self._log_scale = log_scale
        self._relaxed = self.config.lag  # views at the last relaxation; before, the window holds all

    @property
    def n_views(self) -> int:
        return self.map.n_views

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors but those of the map and the links between scales."""
        return self._factors.graph

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
            InputError: the view cannot be used; the message says why and the estimator is as it was before. What a
                factor of the user raises later, during the minimisation, is passed on and changes nothing either.
        """
        number = self.n_views
        if number >= self.config.growth * self._relaxed:
            self.relax()
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
            graph = self._poses(number, pose, scale, step, sigmas)
            if factors is not None:
                push_back(graph, factors)
            trial = gtsam.Values(self.values)
            trial.insert(new)
            try_out(graph, new, trial)
            first = max(0, number - self.config.lag + 1)
            tied = self._factors.around(first, number, graph, recent=number - 2 * self.config.lag)
            for n in range(max(1, first), number + 1):
                tied.add(link_scales(n - 1, n, self.noise))
            window = Window(self.map, view, first, tied, trial, self.noise, self.config.map)
            state, estimate = window.minimise(self.config.levenberg)
        except InputError as error:
            raise InputError(f"view {number}: {error}; the view was not added") from error
        # Nothing can fail from here on.
        trial.update(estimate)
        self.values = trial
        self._factors.append(graph)
        self.map.append(view)
        window.store(state)
        return number

    def relax(self) -> None:
        """Move all cameras with the shapes of their surfaces given; done by itself as the sequence grows."""
        self.values = relaxed(self.map, self.graph, self.values, self.noise, self.config.relaxation)
        self._relaxed = max(self.n_views, self.config.lag)

    def pose(self, view: int) -> np.ndarray:
        """(4, 4) camera to world, the current estimate."""
        return np.asarray(self.values.atPose3(pose_key(view)).matrix())

    def log_scale(self, view: int) -> float:
        """Current estimate of the log scale of a view."""
        return float(self.values.atVector(key(VIEW_SCALE, 0, view))[0])

    def map_points(self, view: int) -> np.ndarray:
        """(N, 3) current estimate of where the points of a view were in the world."""
        pose = self.pose(view)
        return pose[:3, 3] + np.exp(self.log_scale(view)) * self.map.shape[view] @ pose[:3, :3].T

    def cost(self) -> float:
        """Cost of the whole estimate: what `finish` starts from, comparable with `Fused.cost`."""
        sightings, log_depth, points = self._estimate()
        terms = MapTerms(sightings, self.noise, self.config.map)
        cameras = camera_arrays(self.values, range(self.n_views))
        state = MapState(*cameras, log_depth[terms.view, terms.point], points[terms.view, terms.point])
        links = [link_scales(n, n + 1, self.noise) for n in range(self.n_views - 1)]
        return terms.cost(state) + self.graph.error(self.values) + sum(link.error(self.values) for link in links)

    def estimate(self) -> Fused:
        """The current estimate of everything so far, without covariances."""
        sightings, log_depth, points = self._estimate()
        others = gtsam.Values(self.values)
        for k in [k for view in range(self.n_views) for k in camera_keys(view)]:
            others.erase(k)
        cost = self.cost()
        return Fused(
            poses=np.array([self.pose(view) for view in range(self.n_views)]),
            log_scale=np.array([self.log_scale(view) for view in range(self.n_views)]),
            points=np.where(sightings.seen[..., None], points, np.nan),
            log_depth=np.where(sightings.seen, log_depth, np.nan),
            camera_covariance=np.full((self.n_views, CAMERA, CAMERA), np.nan),
            others=others,
            cost=cost,
            cost_history=(cost,),
        )

    def finish(self, config: FusionConfig | None = None) -> Fused:
        """The batch fusion of everything so far, from the current estimate.

        Raises:
            InputError: there are more than `fuse.MOST_VIEWS` views; `estimate` has no such limit.
        """
        config = config or FusionConfig(map=self.config.map)
        sightings, log_depth, points = self._estimate()
        return fuse(sightings, self.noise, self.graph, self.values, config, estimate=(log_depth, points))

    def _estimate(self) -> tuple[Sightings, np.ndarray, np.ndarray]:
        """What all views saw, estimated log depths (F, P) and map points (F, P, 3); 0 where not seen."""
        sightings = self.map.sightings()
        log_depth, points = np.zeros(sightings.seen.shape), np.zeros((*sightings.seen.shape, 3))
        for number, view in enumerate(self.map.views):
            log_depth[number, view.points] = self.map.log_depth[number]
            points[number, view.points] = self.map_points(number)
        return sightings, log_depth, points

    def _predicted(self, view: View, step: np.ndarray | None) -> tuple[gtsam.Pose3, float]:
        """Pose and log scale to start a view from: by odometry, or by the map as it was last seen."""
        if not self.n_views:
            return self._first, self._log_scale
        scale = self.log_scale(self.n_views - 1)
        if step is not None:
            return gtsam.Pose3(self.pose(self.n_views - 1) @ np.asarray(step, dtype=float)), scale
        last = [self.map.last_sighting(point) for point in view.points.tolist()]
        known = [row for row, sighting in enumerate(last) if sighting is not None]
        if len(known) < _FEWEST:
            raise InputError(f"it shares {len(known)} points with the map, expected {_FEWEST}, and has no odometry")
        target = np.array([self.map_points(number)[row] for number, row in filter(None, last)])
        _, R, t = align_similarity(np.exp(scale) * view.camera_points()[known], target)
        return gtsam.Pose3(gtsam.Rot3(R), t), scale

    def _poses(
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
