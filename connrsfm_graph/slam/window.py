"""The newest views as a problem of their own, given the estimates of all before.

The cost is that of `assemble`, cut at the oldest free view: a point that comes back is tied to where it was last seen,
with a variance that has grown with time, and odometry to the pose of the view before.
"""

from __future__ import annotations

import gtsam
import numpy as np

from connrsfm_graph.slam.assemble import MapModel, pose_key
from connrsfm_graph.slam.elimination import MapState, MapTerms
from connrsfm_graph.slam.growing_map import GrowingMap
from connrsfm_graph.slam.minimise import Columns, camera_arrays, minimise
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.slam.sightings import View, stacked
from connrsfm_graph.solvers.interface import Levenberg
from factors.keys import CAMERA_POSE, VIEW_SCALE, decode, key


def camera_keys(view: int) -> tuple[int, int]:
    """Keys of pose and log scale of a view."""
    return pose_key(view), key(VIEW_SCALE, 0, view)


def is_camera(k: int) -> bool:
    """Whether a key is that of a pose or a view's scale."""
    return decode(k)[0] in (CAMERA_POSE, VIEW_SCALE)


class Window:
    """The views from `first` on and one that arrives, free; the sightings before that they are tied to, held."""

    def __init__(
        self,
        known: GrowingMap,
        newest: View,
        first: int,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        noise: FusionNoise,
        model: MapModel,
    ):
        """Gather the window.

        Args:
            known: the map of the views before the newest.
            newest: what the view that arrives saw.
            first: oldest view that is free.
            graph: all factors on the free views but those of the map.
            values: their variables and all cameras; variables other than cameras are free.
            noise, model: as in `assemble.add_reconstruction`.
        """
        self.known = known
        number = known.n_views
        views = [*known.views, newest]
        points = np.unique(np.concatenate([view.points for view in views[first:]]))
        rows = {n: list(range(len(views[n].points))) for n in range(first, number + 1)}
        for point in points.tolist():
            for n, row in known.before(point, first):
                rows.setdefault(n, []).append(row)
        self.numbers = sorted(rows)
        # Columns of the arrays are points in ascending order.
        chosen = {n: np.array(mine, dtype=int) for n, mine in rows.items()}
        self.rows = [chosen[n][np.argsort(views[n].points[chosen[n]])] for n in self.numbers]
        held = np.array(self.numbers) < first
        sightings = stacked([views[n] for n in self.numbers], self.rows, points)
        self.terms = MapTerms(sightings, noise, model, np.array(self.numbers), held)
        self.graph = graph
        cameras = [k for n in self.numbers for k in camera_keys(n)]
        self.values = values.extract(list({*cameras, *graph.keyVector()}))
        moving = {k for n in range(first, number + 1) for k in camera_keys(n)}
        resting = {k for k in self.values.keys() if is_camera(k) and k not in moving}
        self.columns = Columns(graph, self.values, cameras, resting)

    def minimise(self, settings: Levenberg) -> tuple[MapState, gtsam.Values]:
        """Map and variables after minimisation from the current estimate."""
        cameras = camera_arrays(self.values, self.numbers)
        start = self.terms.start(*cameras)
        for local, (n, rows) in enumerate(zip(self.numbers, self.rows, strict=True)):
            if n < self.known.n_views:
                mine = self._mine(local)
                R, t, g = (array[local] for array in cameras)
                start.b[mine] = self.known.log_depth[n][rows]
                start.m[mine] = t + np.exp(g) * self.known.shape[n][rows] @ R.T
        state, values, _ = minimise(self.terms, start, self.graph, self.values, self.columns, settings)
        return state, values

    def store(self, state: MapState) -> None:
        """Write the free part of the map back; the newest view has been appended to it."""
        for local, (n, rows) in enumerate(zip(self.numbers, self.rows, strict=True)):
            mine = self._mine(local)
            if self.terms.free[mine].all():
                self.known.log_depth[n][rows] = state.b[mine]
                self.known.shape[n][rows] = np.exp(-state.g[local]) * (state.m[mine] - state.t[local]) @ state.R[local]

    def _mine(self, local: int) -> np.ndarray:
        """Sightings of one view, in order of points."""
        return np.flatnonzero(self.terms.view == local)
