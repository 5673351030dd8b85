"""Depth of a new view from pair factors against keyframes, when views arrive one by one.

The image graph grows greedily: a new view is joined to the keyframe it shares most tracks with, as a maximum spanning
tree would, and then to those that add most to log det of the graph's Laplacian, which is the edge's weight times the
effective resistance between its ends. Only the resistances among the keyframes are kept; forgetting an old keyframe
means dropping its row and column of the inverse, and changes none of the others.

The isometric pair factors of the new view and its keyframes give first-order terms, these are integrated, and the unit
is that of the keyframes' depths. The work per view is bounded by the number of edges. Keyframes must differ: from views
that are nearly the same nothing is learnt about depth.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.image_graph import image_change
from connrsfm_graph.initialise import with_closed_form_scale
from connrsfm_graph.integrate import integrate, terms_of_depth
from connrsfm_graph.problem import Problem, State, flat_state, make_problem
from connrsfm_graph.slam.sightings import View, stacked
from connrsfm_graph.solvers.gtsam_backend import levenberg_marquardt, point_graph
from connrsfm_graph.solvers.interface import PairModel
from connrsfm_graph.warps import WarpConfig, fit_warps
from factors.keys import FIRST_ORDER, decode, key
from factors.noise import PairNoise

_HELD = 0.1
"""Standard deviation of the first-order terms of keyframes: they are estimates too."""


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

    def __post_init__(self) -> None:
        if self.edges < 1 or self.most < self.edges:
            raise InputError(f"keyframes: edges {self.edges} and most {self.most}, expected 1 <= edges <= most")


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
        """Depths of a new view from pair factors against its keyframes.

        Args:
            points: (N,) numbers of the points seen, each once.
            image: (N, 2) normalised image coordinates.

        Returns:
            The points of the view whose depth its pairs determine, in the keyframes' unit.

        Raises:
            InputError: no keyframe shares enough points, or no point has a usable pair.
        """
        new = View.checked(points, image, np.zeros(len(points)))
        related = [self.views[k] for k in self.select(new.points)]
        views = [*related, new]
        numbers = np.unique(np.concatenate([view.points for view in views]))
        local = stacked(views, [np.arange(len(view.points)) for view in views], numbers)
        last = len(related)
        edges = np.array([[k, last] for k in range(last)])
        warps = fit_warps(local.image, local.seen, edges, self.config.warps)
        problem = make_problem(local.image, local.seen, edges, warps.jets, warps.weight * warps.valid)
        if not (problem.weight > 0).any():
            raise InputError("no pair of the view with a keyframe is usable")
        first, second, _ = terms_of_depth(local.image, local.log_depth, local.seen, problem.camera)
        state = flat_state(problem).updated(
            first_order=np.swapaxes(first, 0, 1), second_order=np.swapaxes(second, 0, 1)
        )
        state = _solved(problem, state, last)
        integrated = integrate(problem, state)
        local_depth = np.where(np.arange(last + 1) < last, local.log_depth.T, integrated.log_depth)
        noise = PairNoise(extrinsic=np.inf)
        state = with_closed_form_scale(problem, state.updated(log_depth=local_depth), noise)
        # The median conformal scale of the view's pairs is 1 in the keyframes' unit.
        unit = float(np.median(state.log_scale[problem.weight > 0]))
        column = np.searchsorted(numbers, new.points)
        known = problem.constrained()[column, last]
        return View.checked(new.points[known], new.image[known], integrated.log_depth[column[known], last] + unit)

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


def _solved(problem: Problem, state: State, new: int) -> State:
    """First-order terms of view `new` from the isometric pair factors of every point, those of the others held."""
    first_order = state.first_order.copy()
    held = gtsam.noiseModel.Isotropic.Sigma(2, _HELD)
    for point in np.flatnonzero((problem.weight > 0).any(axis=1)).tolist():
        graph, values = point_graph(problem, state, point, ("d",), PairNoise(), PairModel.ISOMETRIC)
        for k in values.keys():
            if decode(k)[2] != new:
                graph.add(gtsam.PriorFactorVector(k, values.atVector(k), held))
        mine = key(FIRST_ORDER, point, new)
        values.update(mine, np.mean([values.atVector(k) for k in values.keys() if k != mine], axis=0))
        solved, _, _ = levenberg_marquardt(graph, values)
        first_order[point, new] = solved.atVector(mine)
    return state.updated(first_order=first_order)
