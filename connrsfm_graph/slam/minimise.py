"""Levenberg-Marquardt over a map and everything else at once, by the rule of `solvers.interface`.

The map is eliminated in batch (`elimination`), everything else - odometry, priors, rigid landmarks, factors of the
user - is a GTSAM graph that GTSAM linearises. The equations of cameras and other variables are dense, 7 columns per
view: made for hundreds of views, and for landmarks by the hundred.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

import gtsam
import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam.assemble import pose_key
from connrsfm_graph.slam.elimination import CAMERA, MapState, MapTerms, Reduced
from connrsfm_graph.solvers.interface import MAX_DAMPING, MIN_DAMPING, Levenberg
from factors.keys import VIEW_SCALE, decode, key


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
                step = damped_step(terms, state, columns, hessian, gradient, damping)
                next_state, next_values = _moved(terms, state, values, columns, *step)
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


def damped_step(
    terms: MapTerms,
    state: MapState,
    columns: Columns,
    hessian: np.ndarray,
    gradient: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Damped Gauss-Newton step of all columns, of the log depths (N,) and of the map points (N, 3)."""
    reduced, normal, right = joined(terms, state, columns, hessian, gradient, damping)
    step = np.zeros(columns.total)
    step[columns.free] = cho_solve(cho_factor(normal, lower=True, overwrite_a=True), -right)
    return step, *reduced.back_substitute(step[: columns.n_cameras])


def _moved(
    terms: MapTerms, state: MapState, values: gtsam.Values, columns: Columns, step: np.ndarray, *map_step: np.ndarray
) -> tuple[MapState, gtsam.Values]:
    """State and values after a step.

    The step of a map point is taken in its camera's frame and unit, and the point moves along with the camera: turning
    or scaling views together with their surfaces then changes no anchor, however far, and a wrong scale is left in a
    few steps.
    """
    trial = values.retract(columns.vectors(step))
    views = [decode(k)[2] for k in columns.cameras[::2]]
    R, t, g = camera_arrays(trial, views)
    depths, points = map_step
    view = terms.view
    omega, v, dg = np.split(step[: columns.n_cameras].reshape(-1, CAMERA)[view], (3, 6), axis=1)
    local = _rotated(np.swapaxes(state.R, 1, 2)[view], state.m - state.t[view])
    change = _rotated(np.swapaxes(state.R, 1, 2)[view], points) - v - np.cross(omega, local) - dg * local
    grown = np.exp(g - state.g)[view, None]
    m = np.where(terms.free[:, None], t[view] + grown * _rotated(R[view], local + change), state.m)
    return MapState(R, t, g, state.b + depths, m), trial


def _rotated(R: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", R, x)


def joined(
    terms: MapTerms, state: MapState, columns: Columns, hessian: np.ndarray, gradient: np.ndarray, damping: float
) -> tuple[Reduced, np.ndarray, np.ndarray]:
    """The normal equations of the free cameras and other variables, the map eliminated."""
    reduced = terms.reduce(state, damping)
    n = columns.n_cameras
    normal, right = hessian + damping * np.eye(columns.total), gradient.copy()
    normal[:n, :n] += reduced.hessian
    right[:n] += reduced.gradient
    return reduced, normal[np.ix_(columns.free, columns.free)], right[columns.free]


def camera_arrays(values: gtsam.Values, views: Iterable[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (F, 3, 3), centres (F, 3) and log scales (F,) of some views."""
    cameras = [(values.atPose3(pose_key(view)), values.atVector(key(VIEW_SCALE, 0, view))[0]) for view in views]
    return (
        np.array([pose.rotation().matrix() for pose, _ in cameras]),
        np.array([pose.translation() for pose, _ in cameras]),
        np.array([g for _, g in cameras]),
    )
