"""The estimation problem as arrays: the single source of truth for both backends.

Indices: points i (P), images j (F), edges e = (a, b) (E). Arrays are point-major, because points are independent in
the point-wise steps. NaN never enters: a pair or an observation that is absent has weight 0 or is masked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factors.noise import PairNoise
from factors.surface import PERSPECTIVE, Camera, planar_second_order
from factors.warp_jet import WarpJet


@dataclass(frozen=True)
class Problem:
    """What was measured: image points and, for every point and edge, the warp's 2-jet."""

    image: np.ndarray
    """(P, F, 2) normalised image coordinates, 0 where not visible."""
    visible: np.ndarray
    """(P, F) bool."""
    edges: np.ndarray
    """(E, 2) int, images a and b; the warp maps a to b."""
    data: np.ndarray
    """(P, E, 14) pair data (see `factors.warp_jet`), 0 where the pair is absent."""
    weight: np.ndarray
    """(P, E) weight of each pair, 0 where it is absent."""
    camera: Camera = PERSPECTIVE
    precision: np.ndarray | None = None
    """(P, E, 21) factors on the precision that the pair factors' noise gives each row, positive; None for 1."""

    @property
    def n_points(self) -> int:
        return self.image.shape[0]

    @property
    def n_frames(self) -> int:
        return self.image.shape[1]

    @property
    def n_edges(self) -> int:
        return len(self.edges)

    def constrained(self) -> np.ndarray:
        """(P, F) bool: the point has at least one usable pair in this image."""
        touched = np.zeros((self.n_points, self.n_frames), dtype=bool)
        for end in (0, 1):
            np.logical_or.at(touched.T, self.edges[:, end], (self.weight > 0).T)
        return touched

    def points(self, block: slice | np.ndarray) -> Problem:
        """The problem of some points."""
        return replace(
            self,
            image=self.image[block],
            visible=self.visible[block],
            data=self.data[block],
            weight=self.weight[block],
            precision=None if self.precision is None else self.precision[block],
        )

    def row_precisions(self, noise: PairNoise) -> np.ndarray:
        """(P, E, 21) reciprocal standard deviations of the rows of every pair; 0 for dropped blocks."""
        shared = noise.precisions()
        if self.precision is None:
            return np.tile(shared, (self.n_points, self.n_edges, 1))
        return shared * self.precision


@dataclass(frozen=True)
class State:
    """What is estimated. Arrays are not modified in place by the solvers."""

    frame: np.ndarray
    """(P, F, 6): y1, y2, y11, y12, y22 and log depth of every point in every image."""
    log_scale: np.ndarray
    """(P, E) log conformal scale, size in image a over size in image b."""

    @property
    def first_order(self) -> np.ndarray:
        """(P, F, 2) view."""
        return self.frame[..., 0:2]

    @property
    def second_order(self) -> np.ndarray:
        """(P, F, 3) view."""
        return self.frame[..., 2:5]

    @property
    def log_depth(self) -> np.ndarray:
        """(P, F) view."""
        return self.frame[..., 5]

    def updated(
        self,
        first_order: np.ndarray | None = None,
        second_order: np.ndarray | None = None,
        log_depth: np.ndarray | None = None,
        log_scale: np.ndarray | None = None,
    ) -> State:
        """A copy with some variables replaced."""
        frame = self.frame.copy()
        for columns, value in ((slice(0, 2), first_order), (slice(2, 5), second_order), (5, log_depth)):
            if value is not None:
                frame[..., columns] = value
        return State(frame, self.log_scale.copy() if log_scale is None else np.array(log_scale, dtype=float))

    def pair(self, point: int, edge: int, views: tuple[int, int]) -> np.ndarray:
        """(13,) variables of one pair in the order of `factors.conformal_pair`."""
        a, b = views
        return np.concatenate([self.frame[point, a], self.frame[point, b], self.log_scale[point, edge : edge + 1]])


def make_problem(
    image: np.ndarray,
    visible: np.ndarray,
    edges: np.ndarray,
    jets: WarpJet,
    weight: np.ndarray,
    camera: Camera = PERSPECTIVE,
) -> Problem:
    """Gather tracks and warps into a problem.

    Args:
        image: (F, P, 2) normalised coordinates; entries that are not visible are ignored.
        visible: (F, P) bool.
        edges: (E, 2).
        jets: warp jets with leading dimensions (E, P).
        weight: (E, P) weight of each pair, 0 where it must not be used.
        camera: camera model.
    """
    image = np.where(visible[..., None], image, 0.0)
    usable = (weight > 0) & visible[edges[:, 0]] & visible[edges[:, 1]]
    data = jets.pair_data(image[edges[:, 0]], image[edges[:, 1]])
    usable &= np.isfinite(data).all(axis=-1)
    data = np.where(usable[..., None], data, 0.0)
    weight = np.where(usable, weight, 0.0)
    return Problem(
        image=np.ascontiguousarray(image.transpose(1, 0, 2)),
        visible=np.ascontiguousarray(visible.T),
        edges=np.ascontiguousarray(edges, dtype=np.int64),
        data=np.ascontiguousarray(data.transpose(1, 0, 2)),
        weight=np.ascontiguousarray(weight.T, dtype=float),
        camera=camera,
    )


def flat_state(problem: Problem) -> State:
    """Fronto-parallel planes at depth 1, scale 1: all variables zero."""
    return State(np.zeros((problem.n_points, problem.n_frames, 6)), np.zeros((problem.n_points, problem.n_edges)))


def planar_state(problem: Problem, first_order: np.ndarray) -> State:
    """State with given first-order terms (P, F, 2) and the second-order terms of the tangent planes."""
    return flat_state(problem).updated(
        first_order=first_order, second_order=planar_second_order(first_order, problem.camera)
    )
