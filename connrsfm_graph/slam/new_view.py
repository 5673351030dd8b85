"""Surface of a view that has just arrived, from keyframes whose depths are known.

The isometric pair factors of the view and its keyframes give first-order terms, these are integrated, and the unit is
that of the keyframes' depths. From there, and from the depths of the newest keyframe, the view moves to the minimum of
the refinement's cost over the lengths that the keyframes show; the better of the two is taken.
"""

from __future__ import annotations

import gtsam
import numpy as np

from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.initialise import with_closed_form_scale
from connrsfm_graph.integrate import integrate
from connrsfm_graph.problem import Problem, State, flat_state, make_problem
from connrsfm_graph.refine.cost import Weights
from connrsfm_graph.refine.measurements import Measurements, Shape
from connrsfm_graph.refine.mesh import surface_mesh
from connrsfm_graph.refine.solve import fit_views
from connrsfm_graph.refine.start import log_chords
from connrsfm_graph.refine.thin_plate import fit_thin_plate
from connrsfm_graph.refine.uncertainty import log_depth_deviation
from connrsfm_graph.slam.sightings import View, stacked
from connrsfm_graph.solvers.gtsam_backend import levenberg_marquardt, point_graph
from connrsfm_graph.solvers.interface import PairModel
from connrsfm_graph.surface_spline import terms_of_depth
from connrsfm_graph.warps import WarpConfig, fit_warps
from factors.keys import FIRST_ORDER, decode, key
from factors.noise import PairNoise

_HELD = 0.1
"""Standard deviation of the first-order terms of keyframes: they are estimates too."""
_UNKNOWN = 1e-3
"""Weight of a length that no keyframe shows, relative to the others."""
_WEIGHTS = Weights(huber=1.0, bending=0.0, smoothness=1.0, drift=0.3, unit=1e3)
"""Of the refinement's terms; there is no conformal factor here and the lengths are held."""
_ITERATIONS, _TOLERANCE = 30, 1e-3


def from_pairs(new: View, related: list[View], config: WarpConfig) -> View:
    """Depths from pair factors against keyframes; points without a pair lie on the surface through the others.

    Args:
        new: what the view saw; its depths are not looked at.
        related: the keyframes, in one unit.
        config: of the image warps.

    Raises:
        InputError: too few points have a usable pair.
    """
    views = [*related, new]
    numbers = np.unique(np.concatenate([view.points for view in views]))
    local = stacked(views, [np.arange(len(view.points)) for view in views], numbers)
    last = len(related)
    edges = np.array([[k, last] for k in range(last)])
    warps = fit_warps(local.image, local.seen, edges, config)
    problem = make_problem(local.image, local.seen, edges, warps.jets, warps.weight * warps.valid)
    first, second, _ = terms_of_depth(local.image, local.log_depth, local.seen, problem.camera)
    state = flat_state(problem).updated(first_order=np.swapaxes(first, 0, 1), second_order=np.swapaxes(second, 0, 1))
    state = _solved(problem, state, last)
    try:
        integrated = integrate(problem, state)
    except ComputationError as error:
        raise InputError("too few of its pairs with keyframes are usable") from error
    local_depth = np.where(np.arange(last + 1) < last, local.log_depth.T, integrated.log_depth)
    state = with_closed_form_scale(problem, state.updated(log_depth=local_depth), PairNoise(extrinsic=np.inf))
    # The median conformal scale of the view's pairs is 1 in the keyframes' unit.
    unit = float(np.median(state.log_scale[problem.weight > 0]))
    column = np.searchsorted(numbers, new.points)
    return View.checked(new.points, new.image, integrated.log_depth[column, last] + unit)


def from_lengths(start: View, keyframes: list[View], image_sigma: float, length_sigma: float) -> View:
    """The surface whose lengths between neighbours are those of keyframes, and how sure its depths are.

    Args:
        start: what the view saw, with depths to start from; those of the newest keyframe are tried as well.
        keyframes: all of them, oldest first, in the unit of `start`.
        image_sigma, length_sigma: as in `KeyframeConfig`.
    """
    views = [*keyframes, start]
    numbers = np.unique(np.concatenate([view.points for view in views]))
    known = stacked(views, [np.arange(len(view.points)) for view in views], numbers)
    column = np.searchsorted(numbers, start.points)
    points, seen, log_depth = known.points()[:, column], known.seen[:, column], known.log_depth[:, column]

    def shown(pairs: np.ndarray) -> np.ndarray:
        return seen[:-1, pairs[:, 0]] & seen[:-1, pairs[:, 1]]

    def log_length(pairs: np.ndarray) -> np.ndarray:
        """Median over the keyframes that show both ends; as it is at the start where none does."""
        chords = log_chords(points, pairs)
        chords[:-1][~shown(pairs)] = np.nan
        chords[-1, shown(pairs).any(axis=0)] = np.nan
        return np.asarray(np.nanmedian(chords, axis=0))

    mesh = surface_mesh(start.image, log_length)
    depths = start.log_depth[None]
    if (same := seen[-2]).any():
        newest = fit_thin_plate(start.image[same], log_depth[-2, same, None])(start.image)[:, 0]
        depths = np.stack([start.log_depth, np.where(same, log_depth[-2], newest)])
    weight = np.where(shown(mesh.edges).any(axis=0), 1.0, _UNKNOWN) / length_sigma
    measurements = Measurements(
        image=np.tile(start.image, (len(depths), 1, 1)),
        image_weight=np.full(depths.shape, 1.0 / image_sigma),
        log_depth=depths,
        log_length=log_length(mesh.edges),
        log_length_weight=np.zeros(len(mesh.edges)),
        length_weight=np.tile(weight, (len(depths), 1)),
        factor_weight=np.ones(len(depths)),
        strain_weight=0.0,
        mesh=mesh,
        frontal=np.zeros(len(mesh.edges)),
        weights=_WEIGHTS,
    )
    N = len(start.points)
    none = np.empty((len(depths), 0))
    shape = Shape(depths, np.zeros((len(depths), N, 2)), none, log_length(mesh.edges), none)
    shape, cost = fit_views(measurements, shape, _ITERATIONS, _TOLERANCE)
    best = np.array([cost.argmin()])
    unmoved = np.zeros_like(shape.log_length)
    deviation = log_depth_deviation(measurements.views(best), shape.views(best), stretch=False, lengths_pull=unmoved)
    chosen = int(best[0])
    image = start.image + shape.correction[chosen]
    return View.checked(start.points, image, shape.log_depth[chosen], deviation[0])


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
