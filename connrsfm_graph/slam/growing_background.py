"""A rigid background that grows view by view.

A point of the background becomes a landmark when it is seen for the third time: from two views whose poses are
estimated its place can be told. Its earlier sightings are then taken in with the new one.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam.cameras import landmark_factor, nearest_point
from factors.keys import RIGID_LANDMARK, key

_NEEDED = 2
"""Earlier sightings from which a landmark starts."""


class GrowingBackground:
    """What the views have seen of points that do not move."""

    def __init__(self, sigma: float, distance: float):
        """Start empty.

        Args:
            sigma: noise of a coordinate, normalised coordinates.
            distance: rough distance of the scene, for a start where the rays do not tell.
        """
        self.sigma = sigma
        self.distance = distance
        self._landmarks: set[int] = set()
        self._sightings: dict[int, list[tuple[int, np.ndarray]]] = {}  # of points that are no landmarks yet

    def factors(
        self, view: int, points: np.ndarray, image: np.ndarray, pose: Callable[[int], np.ndarray]
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """What a new view adds to the graph; nothing is kept until `take_in`.

        Args:
            view: its number.
            points: (N,) numbers of the background's points seen, each once.
            image: (N, 2) normalised image coordinates.
            pose: estimated pose (4, 4) of an earlier view.

        Returns:
            Projection factors, and the starts of new landmarks.

        Raises:
            InputError: a point is not finite, or seen twice.
        """
        if len(np.unique(points)) != len(points):
            raise InputError("a point of the background is seen twice, expected each once")
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for point, x in zip(points.tolist(), image, strict=True):
            if not np.isfinite(x).all():
                raise InputError(f"point {point} of the background is not a finite image point")
            earlier = self._sightings.get(point, [])
            if point not in self._landmarks:
                if len(earlier) < _NEEDED:
                    continue
                poses = [gtsam.Pose3(pose(n)) for n, _ in earlier]
                start = nearest_point(poses, np.array([seen for _, seen in earlier]), self.distance)
                values.insert(key(RIGID_LANDMARK, point), start)
                for n, seen in earlier:
                    graph.add(landmark_factor(point, n, seen, self.sigma))
            graph.add(landmark_factor(point, view, x, self.sigma))
        return graph, values

    def take_in(self, view: int, points: np.ndarray, image: np.ndarray) -> None:
        """Keep what a view saw, whose factors have been added."""
        for point, x in zip(points.tolist(), image, strict=True):
            if point in self._landmarks:
                continue
            if len(self._sightings.get(point, [])) >= _NEEDED:
                self._landmarks.add(point)
                del self._sightings[point]
            else:
                self._sightings.setdefault(point, []).append((view, np.array(x)))
