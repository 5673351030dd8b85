"""Keyframes: which of the views that arrive one by one are kept, and to which ones a new view is related.

The image graph grows greedily: a new view is joined to the keyframe it shares most tracks with, as a maximum spanning
tree would, and then to those that add most to log det of the graph's Laplacian, which is the edge's weight times the
effective resistance between its ends. Only the resistances among the keyframes are kept; forgetting an old keyframe
means dropping its row and column of the inverse, and changes none of the others.

The work per view is bounded by the numbers of edges and of keyframes. Keyframes must differ: from views that are nearly
the same nothing is learnt about depth (`new_view`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.image_graph import image_change
from connrsfm_graph.slam.new_view import from_lengths, from_pairs
from connrsfm_graph.slam.sightings import View
from connrsfm_graph.warps import WarpConfig


@dataclass(frozen=True)
class KeyframeConfig:
    """Which views are kept as keyframes and how many a new view is related to."""

    edges: int = 4
    """Keyframes a new view is related to, at most."""
    min_shared: int = 10
    """Fewest tracks a view shares with a keyframe it is related to."""
    kept: float = 0.8
    """A view that shares less than this part of its points with the newest keyframe becomes one."""
    change: float = 0.003
    """So does a view whose image differs from the newest keyframe's by more than this (`image_graph.image_change`)."""
    most: int = 40
    """The oldest keyframe is forgotten beyond this many."""
    warps: WarpConfig = field(default_factory=lambda: WarpConfig(model="gaussian_process", covariance=False))
    """Image warps between a new view and its keyframes."""
    image_sigma: float = 1e-3
    """Standard deviation of a coordinate of the image points, normalised coordinates."""
    length_sigma: float = 0.01
    """Standard deviation of a log length in one view, as in the refinement."""

    def __post_init__(self) -> None:
        if self.edges < 1 or self.most < self.edges:
            raise InputError(f"keyframes: edges {self.edges} and most {self.most}, expected 1 <= edges <= most")
        for name in ("image_sigma", "length_sigma"):
            if not getattr(self, name) > 0:
                raise InputError(f"keyframes: {name} is {getattr(self, name)}, expected a positive number")


class Keyframes:
    """Keyframes with their depths, and the resistances of the graph that relates them."""

    def __init__(self, config: KeyframeConfig | None = None):
        self.config = config or KeyframeConfig()
        self.views: list[View] = []
        """The keyframes, oldest first."""
        self._inverse = np.zeros((0, 0))

    def resistance(self) -> np.ndarray:
        """(K, K) effective resistances between the keyframes."""
        diagonal = np.diag(self._inverse)
        return diagonal[:, None] + diagonal[None] - 2.0 * self._inverse

    def select(self, points: np.ndarray) -> list[int]:
        """The keyframes a view with these points is to be related to, the first one by weight, the others greedily.

        Raises:
            InputError: no keyframe shares enough points.
        """
        return self._joined(points)[0]

    def offer(self, view: View) -> bool:
        """Make a view with known depths a keyframe where the policy asks for one; returns whether it did.

        The first ones come from a reconstruction of the first images.
        """
        if not self.views:
            self.views, self._inverse = [view], np.zeros((1, 1))
            return True
        if not self._is_news(view):
            return False
        _, self._inverse = self._joined(view.points)
        self.views.append(view)
        if len(self.views) > self.config.most:
            del self.views[0]
            self._inverse = self._inverse[1:, 1:]
        return True

    def depths(self, points: np.ndarray, image: np.ndarray) -> View:
        """Depths of a new view from its pairs with keyframes and the lengths that all of them show.

        Args:
            points: (N,) numbers of the points seen, each once.
            image: (N, 2) normalised image coordinates.

        Returns:
            These points on corrected sight rays, in the keyframes' unit; new ones on the surface through the others.

        Raises:
            InputError: no keyframe shares enough points, or too few pairs are usable.
        """
        new = View.checked(points, image, np.zeros(len(points)))
        start = from_pairs(new, [self.views[k] for k in self.select(new.points)], self.config.warps)
        return from_lengths(start, self.views, self.config.image_sigma, self.config.length_sigma)

    def _is_news(self, view: View) -> bool:
        newest = self.views[-1]
        shared, a, b = np.intersect1d(newest.points, view.points, return_indices=True)
        if len(shared) < max(self.config.kept * len(view.points), 3):
            return True
        pair = np.stack([newest.image[a], view.image[b]])
        change = image_change(np.ones(pair.shape[:2], dtype=bool), pair, np.array([[0, 1]]))
        return bool(change[0] > self.config.change)

    def _joined(self, points: np.ndarray) -> tuple[list[int], np.ndarray]:
        """Keyframes to relate a view to, and the inverse Laplacian with the view as its last node."""
        weight = np.array([len(np.intersect1d(view.points, points)) for view in self.views], dtype=float)
        weight[weight < self.config.min_shared] = 0.0
        if not weight.any():
            raise InputError(f"it shares fewer than {self.config.min_shared} tracks with every keyframe")
        # The newest of those that share most.
        first = len(weight) - 1 - int(np.argmax(weight[::-1]))
        G = np.pad(self._inverse, (0, 1), constant_values=0.0)
        G[-1, :-1] = G[:-1, -1] = G[first, :-1]
        G[-1, -1] = G[first, first] + 1.0 / weight[first]
        chosen = [first]
        left = weight.copy()
        left[first] = 0.0
        while len(chosen) < self.config.edges and left.any():
            resistance = np.diag(G)[:-1] + G[-1, -1] - 2.0 * G[:-1, -1]
            k = int(np.argmax(left * resistance))
            u = G[:, -1] - G[:, k]
            G = G - np.outer(u, u) * (left[k] / (1.0 + left[k] * resistance[k]))
            chosen.append(k)
            left[k] = 0.0
        return chosen, G
