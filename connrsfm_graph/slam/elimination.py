"""Anchors, depths and motions of a whole map at once: linearised in batch and eliminated onto the cameras.

The same cost as the factors of `assemble`, point by point. The log depth of a sighting is in one anchor and one prior
and is eliminated first; what is left of the point is a chain of map points (`chain`), whose couplings E to the cameras
reach only the camera of each sighting and the scales of its neighbours. The cameras' normal equations get
-E^T A^-1 E: seven columns per camera, pose and log scale, dense, since every point couples all views that see it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.slam.assemble import MapModel
from connrsfm_graph.slam.chain import factorise, solve, subtract_coupling
from connrsfm_graph.slam.noise import FusionNoise
from connrsfm_graph.slam.sightings import Sightings
from factors.camera_anchor import DEPTH, POINT, linearise_anchors
from factors.map_motion import motion_coefficients, motion_variance, scale_view

CAMERA = 7
"""Columns of a camera: pose (6), log scale (1)."""
_COUPLED = 9
"""Columns a map point is coupled to: its own camera, the scale of the sighting before and of the one after."""


@dataclass(frozen=True)
class MapState:
    """Cameras and map. One row per sighting, point by point and in order of views."""

    R: np.ndarray
    """(F, 3, 3) camera to world."""
    t: np.ndarray
    """(F, 3) camera centres in the world."""
    g: np.ndarray
    """(F,) log scales."""
    b: np.ndarray
    """(N,) log depths in the reconstruction's unit."""
    m: np.ndarray
    """(N, 3) map points in the world."""


@dataclass(frozen=True)
class Reduced:
    """Normal equations H d = -gradient of the cameras after elimination of the map, and the way back."""

    hessian: np.ndarray
    """(7 F, 7 F)"""
    gradient: np.ndarray
    """(7 F,)"""
    chains: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Starts, inverse blocks and recursion of all chains, see `chain.factorise`."""
    coupling: np.ndarray
    """(N, 3, 9)"""
    columns: np.ndarray
    """(N, 9) camera columns of the coupling, -1 for none."""
    point_gradient: np.ndarray
    """(N, 3)"""
    depth_rows: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Of every sighting: coupling of the depth to (camera, map point) (N, 10), gradient (N,), diagonal (N,)."""

    def back_substitute(self, cameras: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steps of depths (N,) and map points (N, 3) for a step of the cameras (7 F,)."""
        padded = np.append(cameras, 0.0)
        right = -(self.point_gradient + np.einsum("nij,nj->ni", self.coupling, padded[self.columns]))
        points = solve(*self.chains, right)
        rows, gradient, diagonal = self.depth_rows
        moved = np.concatenate([padded[self.columns[:, :CAMERA]], points], axis=1)
        return -(gradient + (rows * moved).sum(axis=1)) / diagonal, points


class MapTerms:
    """The map's part of the cost of `assemble.add_reconstruction`."""

    def __init__(
        self,
        sightings: Sightings,
        noise: FusionNoise,
        model: MapModel,
        times: np.ndarray | None = None,
        held: np.ndarray | None = None,
    ):
        """Gather the sightings.

        Args:
            sightings, noise, model: as in `assemble.add_reconstruction`.
            times: (F,) number of each view where they do not follow each other.
            held: (F,) bool, views whose map points keep their places: only their motion to other views counts.
        """
        self.n_views = sightings.n_views
        self.point, self.view = np.nonzero(sightings.seen.T)
        N = len(self.point)
        times = np.arange(self.n_views) if times is None else np.asarray(times)
        self.free = np.ones(N, dtype=bool) if held is None else ~held[self.view]
        self.image = sightings.image[self.view, self.point]
        self.log_depth = sightings.log_depth[self.view, self.point]
        own = sightings.depth_std[self.view, self.point]
        self.depth_weight = self.free * np.where(np.isnan(own), noise.depth, own) ** -2.0
        self.image_weight = self.free * noise.image**-2.0
        self.huber = model.huber
        self.starts = np.append(np.flatnonzero(np.diff(self.point, prepend=-1)), N)
        # Windows of a motion factor: consecutive sightings of one point.
        size = model.window
        first = np.arange(N - size + 1) if size <= N else np.empty(0, dtype=int)
        first = first[(self.point[first] == self.point[first + size - 1]) & self.free[first + size - 1]]
        self.window = first[:, None] + np.arange(size)
        views = self.view[self.window]
        self.coefficients = motion_coefficients(times[views])
        self.motion_weight = 1.0 / (motion_variance(times[views]) * noise.motion**2)
        self.unit_row = scale_view(size)
        # The coupling's columns of the scales of neighbouring sightings, where a motion factor joins them.
        self.columns = np.full((N, _COUPLED), -1)
        self.columns[:, :CAMERA] = CAMERA * self.view[:, None] + np.arange(CAMERA)
        for k in range(size):
            if k != self.unit_row:
                self.columns[self.window[:, k], self._slot(k)] = CAMERA * views[:, self.unit_row] + CAMERA - 1

    def _slot(self, k: int) -> int:
        """Which column of the coupling holds the scale of a window for its k-th sighting."""
        return CAMERA - 1 if k == self.unit_row else (CAMERA if k > self.unit_row else CAMERA + 1)

    def start(self, R: np.ndarray, t: np.ndarray, g: np.ndarray) -> MapState:
        """Map points where cameras, scales and measured depths put them."""
        distance = np.exp(g[self.view] + self.log_depth)[:, None]
        rays = np.concatenate([self.image, np.ones((len(self.image), 1))], axis=1)
        m = t[self.view] + distance * np.einsum("nij,nj->ni", R[self.view], rays)
        return MapState(R, t, g, self.log_depth.copy(), m)

    @np.errstate(over="ignore", invalid="ignore")
    def cost(self, state: MapState) -> float:
        """Half the sum of squares, anchors by Huber's loss; no finite number where poses are beyond all bounds."""
        r, _ = self._anchors(state)
        norm = np.sqrt(self.image_weight * (r**2).sum(axis=1))
        loss = np.where(norm <= self.huber, 0.5 * norm**2, self.huber * (norm - 0.5 * self.huber))
        depth = 0.5 * (self.depth_weight * (state.b - self.log_depth) ** 2).sum()
        motion = 0.5 * (self.motion_weight * (self._motion(state)[0] ** 2).sum(axis=1)).sum()
        return float(loss.sum() + depth + motion)

    def reduce(self, state: MapState, damping: float) -> Reduced:
        """Linearise everything and eliminate depths and map points.

        Raises:
            numpy.linalg.LinAlgError: a chain's matrix is not positive definite.
        """
        N = len(self.point)
        r, J = self._anchors(state)
        norm = np.sqrt(self.image_weight * (r**2).sum(axis=1))
        w = self.image_weight * np.minimum(1.0, self.huber / np.maximum(norm, 1e-300))
        # Held sightings have no weight; ones on their diagonals keep the systems regular.
        fixed = ~self.free
        # Log depths: one row and one column each.
        q = J[:, :, DEPTH.start]
        others = np.concatenate([J[:, :, : DEPTH.start], J[:, :, POINT]], axis=2)
        diagonal = w * (q**2).sum(axis=1) + self.depth_weight + damping + fixed
        rows = w[:, None] * np.einsum("ni,nij->nj", q, others)
        gradient = w * (q * r).sum(axis=1) + self.depth_weight * (state.b - self.log_depth)
        normal = w[:, None, None] * np.einsum("nki,nkj->nij", others, others)
        normal -= rows[:, :, None] * rows[:, None, :] / diagonal[:, None, None]
        right = w[:, None] * np.einsum("ni,nij->nj", r, others) - rows * (gradient / diagonal)[:, None]

        H = np.zeros((self.n_views, CAMERA, CAMERA))
        h = np.zeros((self.n_views, CAMERA))
        np.add.at(H, self.view, normal[:, :CAMERA, :CAMERA])
        np.add.at(h, self.view, right[:, :CAMERA])
        coupling = np.zeros((N, 3, _COUPLED))
        coupling[:, :, :CAMERA] = normal[:, CAMERA:, :CAMERA]
        blocks = normal[:, CAMERA:, CAMERA:] + damping * np.eye(3)
        point_gradient = right[:, CAMERA:]

        # Motion: between the map points of a window, and with the scale that gives its unit.
        motion, unit = self._motion(state)
        size = self.window.shape[1]
        off = np.zeros((3, N))  # off[d, n]: couples sightings n and n + d
        square = self.motion_weight * (motion**2).sum(axis=1)
        scale_views = self.view[self.window[:, self.unit_row]]
        np.add.at(H, (scale_views, CAMERA - 1, CAMERA - 1), square)
        np.add.at(h, (scale_views, CAMERA - 1), -square)
        for k in range(size):
            pull = (self.motion_weight * unit * self.coefficients[:, k])[:, None] * motion
            np.add.at(point_gradient, self.window[:, k], pull)
            np.add.at(coupling[:, :, self._slot(k)], self.window[:, k], -pull)
            for later in range(k, size):
                product = self.motion_weight * unit**2 * self.coefficients[:, k] * self.coefficients[:, later]
                both = (self.free[self.window[:, k]] & self.free[self.window[:, later]]) | (k == later)
                np.add.at(off[later - k], self.window[:, k], product * both)
        blocks += (off[0] + fixed)[:, None, None] * np.eye(3)
        coupling[fixed], point_gradient[fixed] = 0.0, 0.0

        hessian = np.zeros((CAMERA * self.n_views, CAMERA * self.n_views))
        reduced = np.zeros(CAMERA * self.n_views + 1)
        reduced[:-1] = h.ravel()
        inverse, W = np.empty((N, 3, 3)), np.empty((2, N, 3, 3))
        if not factorise(self.starts, blocks, off[1:], inverse, W):
            raise np.linalg.LinAlgError("the chain of a map point is not positive definite")
        subtract_coupling(self.starts, inverse, W, coupling, self.columns, hessian)
        pulled = np.einsum("nij,ni->nj", coupling, solve(self.starts, inverse, W, point_gradient))
        np.add.at(reduced, self.columns, -pulled)
        hessian += hessian.T
        for view in range(self.n_views):
            block = slice(CAMERA * view, CAMERA * (view + 1))
            hessian[block, block] += H[view]
        depth_rows = (rows, gradient, diagonal)
        return Reduced(
            hessian, reduced[:-1], (self.starts, inverse, W), coupling, self.columns, point_gradient, depth_rows
        )

    def _anchors(self, state: MapState) -> tuple[np.ndarray, np.ndarray]:
        view = self.view
        return linearise_anchors(state.R[view], state.t[view], state.g[view] + state.b, self.image, state.m)

    def _motion(self, state: MapState) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (M, 3) of the windows and their units exp(-g) (M,)."""
        unit = np.exp(-state.g[self.view[self.window[:, self.unit_row]]])
        return unit[:, None] * np.einsum("mk,mki->mi", self.coefficients, state.m[self.window]), unit
