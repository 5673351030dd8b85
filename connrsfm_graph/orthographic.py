"""What an orthographic camera asks for beside its factors: Phi = (u, v, beta), image coordinates in units of length.

Distance does not show, so there is no perspective to tell slopes apart. What remains is foreshortening:

- **One scale per image.** The metric up to a scale of each point fits every slope. Images share one unit of length (K
  says how many pixels it has in each), or else one factor per image is estimated; so the conformal scale of a pair is
  the same at all points, and held until the refinement.
- **Pre-step.** Of the pair factors the metric rows are kept, g_a = J^T g_b J with g = I + y y^T. No image shows lengths
  larger than they are: the smallest metric that exceeds those of all images is where Levenberg-Marquardt starts. (At
  y = 0 the rows have no slope.)
- **Mirror images.** y and -y have the same metric, so signs are found afterwards: within an image by the slopes of the
  neighbours, which change evenly; between images by second fundamental forms, which agree more often than not. The
  mirror image of all surfaces in depth remains; by convention most of the surface bulges towards the camera.
- **Refinement.** Seen from far away, perspective is orthography with one scale per image, log depths are depths, and
  inversion about the camera's centre is the mirror image in depth. So the refinement sees the surfaces from `DISTANCE`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from connrsfm_graph.integrate import IntegrationConfig, integrate
from connrsfm_graph.problem import Problem, State, flat_state
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.refine.uncertainty import log_depth_deviation
from connrsfm_graph.solvers.interface import Backend, Levenberg, PairModel
from connrsfm_graph.tracks import Tracks
from factors.noise import PairNoise

SPREAD = 0.3
"""Root mean square distance of the points from their middle inside, about what perspective cameras see."""
DISTANCE = 1e4
"""Where the refinement puts the camera: the surface's relief over it is the error of taking sight rays as parallel."""
METRIC = PairNoise(1.0, np.inf, np.inf)
_LEAST_SLOPE = 0.1
"""Slopes start no smaller: at zero there is no way out."""
_SAME_UNIT = 0.1
"""Images share their unit unless the estimated logarithms of their factors differ from their mean by more than this."""
_UNIT_ROUNDS = 5
_NEIGHBOURS = 10
_EVENNESS = 0.3
"""Weight against changes of the slope where a few neighbours leave them open, per squared spacing of the points."""
_ROUNDS = 3
"""Signs are compared with the integrated surface so many times."""


def in_own_unit(tracks: Tracks) -> tuple[Tracks, float]:
    """The tracks in the unit of length in which points spread as perspective cameras see them, and that unit."""
    image = tracks.normalised()
    unit = float(np.sqrt(np.nanmean((image - np.nanmean(image, axis=1, keepdims=True)) ** 2) * 2.0)) / SPREAD
    K = tracks.K.copy()
    K[:, :2, :2] *= unit
    return replace(tracks, K=K), unit


def in_unit_of(tracks: Tracks, result: Reconstruction, unit: float) -> Reconstruction:
    """A result for `in_own_unit(tracks)` in the unit of the tracks."""
    return replace(
        result,
        K=tracks.K,
        points=result.points * unit,
        depth=result.depth * unit,
        second_order=result.second_order / unit,
        depth_std=result.depth_std * unit,
        alternative=None if result.alternative is None else result.alternative * unit,
    )


def initialise_orthographic(problem: Problem, backend: Backend, settings: Levenberg) -> State:
    """First- and second-order terms of every point from isometry, mirror images decided; scales from the images' units.

    Raises:
        ComputationError: an image has fewer than three points with a pair.
    """
    jacobian, reference = _from_reference(problem)
    unit = log_units(jacobian, reference)
    if np.abs(unit).max() <= _SAME_UNIT:
        unit[:] = 0.0
    a, b = problem.edges.T
    start = flat_state(problem).updated(
        first_order=_sign_free_slopes(jacobian, reference, unit),
        log_scale=np.where(problem.weight > 0, unit[b] - unit[a], 0.0),
    )
    slopes = backend.minimise(problem, start, ("d",), METRIC, PairModel.CONFORMAL, settings).state.first_order.copy()
    constrained = problem.constrained()
    for f in range(problem.n_frames):
        points = np.flatnonzero(constrained[:, f])
        slopes[points, f] *= even_signs(problem.image[points, f], slopes[points, f])[:, None]
    for _ in range(_ROUNDS):
        surface = integrate(problem, flat_state(problem).updated(first_order=slopes), IntegrationConfig())
        against = (slopes * surface.first_order).sum(axis=-1) < 0.0
        if not against.any():
            break
        slopes = np.where(against[..., None], -slopes, slopes)
    sign = _agreeing_signs(problem, slopes, surface.second_order)[:, None]
    return start.updated(first_order=sign * slopes, second_order=sign * surface.second_order)


def log_units(jacobian: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(F,) logarithms, mean 0, of the factors to a common unit of length, from what `_from_reference` gives.

    In the common unit lengths show at most their true size in every image, and somewhere that size: an image that shows
    all of them smaller than another image does is given a larger factor.
    """
    linked = reference == np.where(reference >= 0, reference, len(reference)).min(axis=1, keepdims=True)
    unit = np.zeros(reference.shape[1])
    for _ in range(_UNIT_ROUNDS):
        shown = _shown(jacobian, linked, unit)
        half = np.linalg.inv(np.linalg.cholesky(_least_above_all(shown)))[:, None]
        largest = np.linalg.eigvalsh(half @ shown @ np.swapaxes(half, 2, 3))[..., 1]
        for f, points in enumerate(linked.T):
            unit[f] -= 0.5 * np.log(np.median(largest[points, f])) if points.any() else 0.0
        unit -= unit.mean()
    return unit


def _sign_free_slopes(jacobian: np.ndarray, reference: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """(P, F, 2) slopes, up to sign, of the smallest metric of each point that no image's exceeds."""
    slopes = np.zeros((*reference.shape, 2))
    for r in np.unique(reference[reference >= 0]):
        linked = reference == r
        points = np.flatnonzero(linked.any(axis=1))
        linked = linked[points]
        shown = _shown(jacobian[points], linked, unit)
        back = np.linalg.inv(np.where(linked[..., None, None], jacobian[points], np.eye(2)))
        own = _least_above_all(shown)[:, None] - shown
        excess, axis = np.linalg.eigh(np.swapaxes(back, 2, 3) @ own @ back * np.exp(-2.0 * unit)[:, None, None])
        steepest = np.sqrt(np.maximum(excess[..., 1], _LEAST_SLOPE**2))[..., None] * axis[..., 1]
        slopes[points] = np.where(linked[..., None], steepest, slopes[points])
    return slopes


def _shown(jacobian: np.ndarray, linked: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """(P, F, 2, 2) metrics over the reference that the images show in the common unit, tiny where not linked."""
    J = np.where(linked[..., None, None], jacobian * np.exp(unit)[:, None, None], 1e-9 * np.eye(2))
    return np.swapaxes(J, 2, 3) @ J


def _from_reference(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (P, F, 2, 2) of the map to every image from the point's reference, chained, and that reference (P, F).

    References are the first images of what a point's pairs connect; -1 where it has no pair.
    """
    P, F = problem.visible.shape
    J = problem.data[..., 4:8].reshape(P, problem.n_edges, 2, 2)
    present = problem.weight > 0
    jacobian, reference = np.zeros((P, F, 2, 2)), np.full((P, F), -1)
    constrained = problem.constrained()
    while (new := constrained & (reference < 0)).any():
        points = np.flatnonzero(new.any(axis=1))
        first = new[points].argmax(axis=1)
        jacobian[points, first], reference[points, first] = np.eye(2), first
        growing = True
        while growing:
            growing = False
            for e, (a, b) in enumerate(problem.edges):
                for here, there in ((a, b), (b, a)):
                    p = np.flatnonzero(present[:, e] & (reference[:, here] >= 0) & (reference[:, there] < 0))
                    step = J[p, e] if here == a else np.linalg.inv(J[p, e])
                    jacobian[p, there], reference[p, there] = step @ jacobian[p, here], reference[p, here]
                    growing |= len(p) > 0
    return jacobian, reference


def _least_above_all(shown: np.ndarray) -> np.ndarray:
    """(P, 2, 2) metrics that exceed those of all images (P, F, 2, 2), one after the other by as little as possible."""
    g = shown.max(axis=(1, 2, 3))[:, None, None] * 1e-12 * np.eye(2)
    for other in np.moveaxis(shown, 1, 0):
        L = np.linalg.cholesky(g)
        half = np.linalg.inv(L)
        size, axis = np.linalg.eigh(half @ other @ np.swapaxes(half, 1, 2))
        root = L @ (axis * np.sqrt(np.maximum(size, 1.0))[:, None])
        g = root @ np.swapaxes(root, 1, 2)
    return g


def even_signs(image: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """(N,) signs with which slopes known up to sign change evenly over the image.

    From the steepest point on, the point whose sign is surest gets the one nearer to a linear fit of its neighbours.
    (A slope that passes zero turns its sign; nearness alone would make a fold or an inflection of every ridge.)

    Args:
        image: (N, 2) image points.
        slopes: (N, 2).
    """
    N = len(image)
    distance, near = cKDTree(image).query(image, k=min(_NEIGHBOURS + 1, N))
    spacing = max(float(np.median(distance[:, 1])), 1e-300)
    around: list[set[int]] = [set() for _ in range(N)]
    for i, k in zip(np.repeat(np.arange(N), near.shape[1]).tolist(), near.ravel().tolist(), strict=True):
        if i != k:
            around[i].add(k)
            around[k].add(i)
    neighbours = [np.array(sorted(points)) for points in around]
    sign = np.zeros(N)
    waiting: list[tuple[float, int, float]] = []

    def settle(point: int, its_sign: float) -> None:
        sign[point] = its_sign
        for k in neighbours[point][sign[neighbours[point]] == 0.0].tolist():
            known = neighbours[k][sign[neighbours[k]] != 0.0]
            A = np.column_stack([np.ones(len(known)), (image[known] - image[k]) / spacing])
            inverse = np.linalg.inv(A.T @ A + np.diag([0.0, _EVENNESS, _EVENNESS]))
            fitted = inverse[0] @ (A.T @ (sign[known, None] * slopes[known]))
            agreement = float(fitted @ slopes[k])
            heapq.heappush(waiting, (-abs(agreement) / inverse[0, 0], k, 1.0 if agreement >= 0.0 else -1.0))

    for first in np.argsort(-np.linalg.norm(slopes, axis=1), kind="stable").tolist():
        if sign[first] == 0.0:
            settle(first, 1.0)
        while waiting:
            _, point, its_sign = heapq.heappop(waiting)
            if sign[point] == 0.0:
                settle(point, its_sign)
    return sign


def _agreeing_signs(problem: Problem, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(F,) which images to mirror so that second fundamental forms agree, and surfaces bulge towards the camera."""
    form = second[..., [0, 1, 1, 2]].reshape(*second.shape[:2], 2, 2)
    form = form / np.sqrt(1.0 + (first**2).sum(axis=-1))[..., None, None]
    agreement = np.eye(problem.n_frames)
    for e, (a, b) in enumerate(problem.edges):
        p = problem.weight[:, e] > 0
        J = problem.data[p, e, 4:8].reshape(-1, 2, 2)
        carried, own = np.swapaxes(J, 1, 2) @ form[p, b] @ J, form[p, a]
        size = np.linalg.norm(carried) * np.linalg.norm(own)
        agreement[a, b] = agreement[b, a] = (carried * own).sum() / max(float(size), 1e-300)
    # The leading eigenvector joins the images whose forms agree, and turns those that disagree.
    sign = np.where(np.linalg.eigh(agreement)[1][:, -1] >= 0.0, 1.0, -1.0)
    bulge = (sign * (second[..., 0] + second[..., 2])).sum()
    return sign if bulge >= 0.0 else -sign


def refine_from_afar(
    image: np.ndarray,
    visible: np.ndarray,
    depth: np.ndarray,
    config: RefineConfig,
    sigma_image: float,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """As `refine`, with depths (F, P) in place of their logarithms; the result's depths are about their mean, and so
    are their standard deviations.

    Each image comes in the unit of its own image points, whatever scale the lengths shared by all asked for.
    """
    log_depth = np.log1p((depth - np.nanmean(depth, axis=1, keepdims=True)) / DISTANCE)
    bare = replace(config, uncertainty=False)
    refined = refine(image / DISTANCE, visible, log_depth, bare, sigma_image / DISTANCE, progress)
    if config.uncertainty:
        fit = refined.reference.fit
        deviation = log_depth_deviation(fit.measurements, fit.shape, stretch=not fit.noisy, about_mean=True)
        depth_std = refined.reference.all_points(deviation * np.exp(fit.shape.log_depth))
        refined = replace(refined, depth_std=depth_std)
    return _brought_back(refined)


def _brought_back(refined: Refined) -> Refined:
    scale = np.nanmean(refined.points[..., 2], axis=1)[:, None] / DISTANCE

    def near(points: np.ndarray) -> np.ndarray:
        middle = np.nanmean(points[..., 2], axis=1, keepdims=True)
        image = DISTANCE * points[..., :2] / points[..., 2:]
        return np.concatenate([image, ((points[..., 2] / middle - 1.0) * DISTANCE)[..., None]], axis=-1)

    points = near(refined.points)
    return replace(
        refined,
        points=points,
        log_depth=points[..., 2],
        depth_std=refined.depth_std / scale,
        ray_correction=refined.ray_correction * DISTANCE,
        log_factor=refined.log_factor - (np.log(scale) if refined.model == "conformal" else 0.0),
        alternative=None if refined.alternative is None else near(refined.alternative),
    )
