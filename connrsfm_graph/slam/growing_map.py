"""A map that grows view by view: what every view saw, where its points are estimated, and which sightings belong
together.

Points are kept in the camera frame of their view and in the reconstruction's unit, so that a camera that is moved or
scaled takes its part of the map along.
"""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from connrsfm_graph.slam.sightings import Sightings, View, stacked


class GrowingMap:
    """The map of the views so far. Views are numbered in order of arrival, points as the caller numbers them."""

    def __init__(self, window: int):
        """Start empty; `window` is the number of sightings that a motion factor spans (`MapModel.window`)."""
        self.window = window
        self.views: list[View] = []
        """What every view saw."""
        self.log_depth: list[np.ndarray] = []
        """(N,) estimated log depths of every view's points, in the reconstruction's unit."""
        self.shape: list[np.ndarray] = []
        """(N, 3) estimated places of every view's points in its camera frame, in the reconstruction's unit."""
        self.motions: dict[tuple[int, ...], list[tuple[int, ...]]] = {}
        """For views that follow each other in the sightings of some points: these points' rows in each."""
        self._history: dict[int, list[tuple[int, int]]] = {}

    @property
    def n_views(self) -> int:
        return len(self.views)

    def append(self, view: View) -> None:
        """Take in the next view, its points where it saw them."""
        number = self.n_views
        self.views.append(view)
        self.log_depth.append(view.log_depth.copy())
        self.shape.append(view.camera_points())
        for row, point in enumerate(view.points.tolist()):
            history = self._history.setdefault(point, [])
            history.append((number, row))
            if len(history) >= self.window:
                views, rows = zip(*history[-self.window :], strict=True)
                self.motions.setdefault(views, []).append(rows)

    def last_sighting(self, point: int) -> tuple[int, int] | None:
        """View and row of the last sighting of a point, None where it is new."""
        history = self._history.get(point)
        return history[-1] if history else None

    def before(self, point: int, view: int) -> list[tuple[int, int]]:
        """View and row of the last sightings of a point before a view: those that tie it to the view's."""
        history = self._history.get(point, [])
        end = bisect_left(history, (view, 0))
        return history[max(0, end - self.window + 1) : end]

    def sightings(self) -> Sightings:
        """What all views saw, points numbered from 0."""
        size = 1 + max((int(view.points.max(initial=-1)) for view in self.views), default=-1)
        return stacked(self.views, [np.arange(len(view.points)) for view in self.views], np.arange(size))
