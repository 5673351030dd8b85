"""How sure depths are that were integrated and not refined.

Every point's subgraph gives its first-order terms a marginal covariance (`solvers.marginals`), and integration is
linear in these: the covariance of a spline's control points follows, and from it that of any depths of an image.

How large all these are, the subgraphs cannot tell. What is wrong with the terms are mostly the warps, whose errors
neighbours share: every point fits its own pairs well, and integration adds the errors up. One factor for the whole
sequence is therefore estimated from what the surfaces say about each other: a length between two points should be the
same in all images, up to the scale of each image. Lengths of all sizes are compared, since errors grow over the
surface. Of what they differ by, the noise of the image points explains a part and the depths the rest. A surface that
stretches makes its depths look less sure than they are, and so do chords across a bend where the depths themselves are
small (orthographic cameras); errors that all images have in common cannot be seen. On simulated isometric surfaces the
mean normalised squared error is 1 within its 95 % interval (tests).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from connrsfm_graph.integrate import IntegrationConfig, smoothing_splines
from connrsfm_graph.problem import Problem
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.interface import Levenberg, PairModel
from connrsfm_graph.solvers.marginals import first_order_covariances
from connrsfm_graph.solvers.separable import SolveConfig, Solved, active_variables
from factors.isometric_pair import ISOMETRIC_ROWS

_LENGTHS = 400
"""Lengths that are compared over the images."""
_ROUNDS = 5
"""Rounds in which lengths and the images' scales are made to agree."""
_CUT = 9.0
"""Squares of normalised differences count no more than this: wrong tracks must not decide."""
_MEAN = 0.995
"""Mean of the square of a standard normal variable that is cut there."""
_LEAST = 1e-12
"""Variance of whitened rows below which pairs agree but for rounding."""


def depth_deviation(
    problem: Problem, solved: Solved, config: SolveConfig, integration: IntegrationConfig, image_sigma: float
) -> np.ndarray:
    """(P, F) standard deviations of integrated log depths (of depths for orthographic cameras), the mean of each image
    left out; 0 where not visible.

    Args:
        problem, solved: the measurements, and what was found.
        config, integration: the settings they were solved and integrated with. Depths integrated by a graph are taken
            to be as sure as those of a spline without smoothing.
        image_sigma: noise of a coordinate of the image points, normalised coordinates; taken as 0 where not known.
    """
    covariance = _of_terms(problem, solved, config)
    bending = solved.integrated.bending
    image_sigma = image_sigma if np.isfinite(image_sigma) else 0.0
    splines, _ = smoothing_splines(problem, solved.state, replace(integration, bending=bending), solved.weight)
    known = problem.constrained() & problem.visible
    deviation = np.zeros(problem.visible.shape)
    pairs = _pairs(problem.visible)
    log_length, by_depth, by_image = (np.full((problem.n_frames, len(pairs)), np.nan) for _ in range(3))
    for j, spline in enumerate(splines):
        seen = problem.visible[:, j]
        values = np.zeros((problem.n_points, spline.grid.n**2))
        values[seen] = spline.values(problem.image[seen, j])
        values[seen] -= values[seen].mean(axis=0)
        control = spline.control_covariance(bending, covariance[known[:, j], j])
        deviation[:, j] = _standard(values, control)
        apart = (problem.image[pairs[:, 0], j] != problem.image[pairs[:, 1], j]).any(axis=1)
        shown = seen[pairs].all(axis=1) & apart  # a point tracked twice has no length to itself
        a, b = pairs[shown].T
        chord, by_a, by_b = _chords(problem, solved.state.log_depth[:, j], j, a, b)
        log_length[j, shown] = 0.5 * np.log((chord**2).sum(axis=1))
        by_depth[j, shown] = _standard(by_a[:, None] * values[a] + by_b[:, None] * values[b], control) ** 2
        by_image[j, shown] = _by_image(problem, solved.state.log_depth[:, j], chord, a, b, image_sigma)
    return np.asarray(np.sqrt(_factor(log_length, by_depth, by_image)) * deviation)


def _of_terms(problem: Problem, solved: Solved, config: SolveConfig) -> np.ndarray:
    """(P, F, 2, 2) marginal covariances of the first-order terms if errors of all rows were independent.

    The variance of the rows is what the pairs leave, and every variable has a prior of 1 in its own unit: slopes and
    curvatures are of that order, and a point with few pairs may not determine all of them.
    """
    present, touched = int((problem.weight > 0).sum()), int(problem.constrained().sum())
    active: tuple[str, ...]
    if config.schedule == "none":
        model, active, redundancy = PairModel.ISOMETRIC, ("d",), ISOMETRIC_ROWS * present - 2 * touched
    else:
        model, active = PairModel.CONFORMAL, active_variables(problem)
        rows = int((config.noise.precisions() > 0).sum())
        redundancy = (rows - ("s" in active)) * present - 5 * touched
    at_minimum = Levenberg(max_iterations=0)
    cost = BatchedBackend().minimise(problem, solved.state, active, config.noise, model, at_minimum).cost.sum()
    variance = max(2.0 * float(cost) / max(redundancy, 1), _LEAST)
    covariance = variance * first_order_covariances(problem, solved.state, active, config.noise, model, variance)
    bare = ~np.isfinite(covariance).all(axis=(-2, -1))
    covariance[bare] = np.eye(2)
    return covariance


def _pairs(visible: np.ndarray) -> np.ndarray:
    """(M, 2) pairs of points that are seen together in some image of (P, F) `visible`, drawn at random."""
    rng = np.random.default_rng(0)
    views = rng.choice(np.flatnonzero(visible.sum(axis=0) >= 2), _LENGTHS)
    drawn = [rng.choice(np.flatnonzero(visible[:, view]), 2, replace=False) for view in views]
    return np.unique(np.sort(drawn, axis=1), axis=0)


def _standard(rows: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations (N,) of linear functions (N, K)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("nk,nk->n", rows @ covariance, rows), 0.0)))


def _chords(
    problem: Problem, log_depth: np.ndarray, view: int, a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chords (M, 3) from points b to a, and the derivatives (M,) of their log lengths by the log depths of a and b."""
    camera = problem.camera
    points = camera.points(problem.image[:, view], np.exp(log_depth) if camera.kappa else log_depth)
    along = points if camera.kappa else np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    chord = points[a] - points[b]
    square = (chord**2).sum(axis=1)
    return chord, (chord * along[a]).sum(axis=1) / square, -(chord * along[b]).sum(axis=1) / square


def _by_image(
    problem: Problem, log_depth: np.ndarray, chord: np.ndarray, a: np.ndarray, b: np.ndarray, sigma: float
) -> np.ndarray:
    """(M,) variance of log lengths by the noise of the image points."""
    depth = np.exp(log_depth) if problem.camera.kappa else np.ones_like(log_depth)
    flat, square = (chord[:, :2] ** 2).sum(axis=1), (chord**2).sum(axis=1)
    return np.asarray(sigma**2 * (depth[a] ** 2 + depth[b] ** 2) * flat / square**2)


def _factor(log_length: np.ndarray, by_depth: np.ndarray, by_image: np.ndarray) -> float:
    """What the variances by depth, (F, M), must be multiplied by to explain how log lengths differ between images."""
    several = np.isfinite(log_length).sum(axis=0) >= 2
    log_length, by_depth, by_image = (array[:, several] for array in (log_length, by_depth, by_image))
    if not several.any():
        return 1.0
    count = np.isfinite(log_length).sum(axis=0)
    for _ in range(_ROUNDS):
        log_length = log_length - np.nanmean(log_length, axis=0)
        scale = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in log_length]
        log_length = log_length - np.array(scale)[:, None]
    square = (log_length - np.nanmean(log_length, axis=0)) ** 2 * count / (count - 1)

    def excess(log_factor: float) -> float:
        normalised = square / (np.exp(log_factor) * by_depth + by_image)
        return float(np.nanmean(np.minimum(normalised, _CUT))) - _MEAN

    return float(np.exp(brentq(excess, 0.0, 50.0, xtol=1e-3))) if excess(0.0) > 0.0 else 1.0
