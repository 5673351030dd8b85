"""Surfaces as a reconstruction reports them, from points or from terms; scales between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.initialise import with_closed_form_scale
from connrsfm_graph.problem import Problem, State
from connrsfm_graph.refine import Refined
from connrsfm_graph.refine.follow import Followed
from connrsfm_graph.solvers.separable import Solved
from connrsfm_graph.surface_spline import terms_of_depth
from factors.noise import PairNoise
from factors.surface import Camera, normals

METRIC_ONLY = PairNoise(intrinsic=math.inf, extrinsic=math.inf)
"""For the scale of a finished surface: only the metric rows hold for every conformal map."""


@dataclass(frozen=True)
class Surfaces:
    """Surfaces of F images at P points; NaN where a point was not recovered. Fields as in `Reconstruction`."""

    points: np.ndarray
    """(F, P, 3)."""
    normals: np.ndarray
    """(F, P, 3)."""
    depth: np.ndarray
    """(F, P)."""
    first_order: np.ndarray
    """(F, P, 2)."""
    second_order: np.ndarray
    """(F, P, 3)."""
    depth_std: np.ndarray
    """(F, P)."""
    log_factor: np.ndarray
    """(F, P)."""
    interpolated: np.ndarray
    """(F, P) bool."""
    outlier: np.ndarray
    """(F, P) bool."""
    ambiguous: np.ndarray
    """(F,) int, 0 where decided."""
    alternative: np.ndarray | None
    """(F, P, 3)."""

    def frame(self) -> np.ndarray:
        """(P, F, 6) variables of the pair factors, 0 where a point was not recovered."""
        log_depth = np.log(np.where(self.depth > 0, self.depth, 1.0))
        terms = np.concatenate([self.first_order, self.second_order, log_depth[..., None]], axis=-1)
        return np.nan_to_num(terms, nan=0.0).transpose(1, 0, 2)


def surfaces_of_terms(problem: Problem, solved: Solved, deviation: np.ndarray) -> Surfaces:
    """Surfaces of the differential solve and its integration.

    Args:
        problem, solved: the measurements, and what was found.
        deviation: (P, F) standard deviation of log depth, of depth for orthographic cameras.
    """
    visible, state = problem.visible.T, solved.state
    first, second = np.moveaxis(state.first_order, 0, 1), np.moveaxis(state.second_order, 0, 1)
    # Points without a usable pair lie on the surface through the others.
    bare = ~problem.constrained().T
    first = np.where(bare[..., None], np.moveaxis(solved.integrated.first_order, 0, 1), first)
    second = np.where(bare[..., None], np.moveaxis(solved.integrated.second_order, 0, 1), second)
    unknown = np.full(visible.shape, np.nan)
    image = np.moveaxis(problem.image, 0, 1)
    depth = np.exp(state.log_depth.T) if problem.camera.kappa else state.log_depth.T
    points = problem.camera.points(image, depth)
    outlier = np.zeros_like(visible)
    depth_std = deviation.T * depth if problem.camera.kappa else deviation.T
    return _surfaces(
        points, image, (first, second), visible, problem.camera, depth_std, unknown, visible & bare, outlier
    )


def surfaces_of_points(
    found: Refined | Followed, constrained: np.ndarray, camera: Camera, bending: float | None = None
) -> tuple[Surfaces, float]:
    """Surfaces of refined points, and the bending weight of the splines that give their terms.

    Args:
        found: refined points of F views.
        constrained: (F, P) bool, points that were seen and have a usable pair.
        camera: camera model.
        bending: weight of the splines' bending energy; chosen by cross-validation where None.
    """
    points = found.points
    recovered = np.isfinite(points).all(axis=-1)
    if camera.kappa and not (points[recovered][:, 2] > 0).all():
        raise ComputationError("the refinement left points without depth; check the tracks for gross errors")
    image = camera.image(np.where(recovered[..., None], points, 1.0))
    first, second, bending = terms_of_depth(image, found.log_depth, recovered, camera, bending)
    interpolated = recovered & ~constrained
    return (
        _surfaces(
            points,
            image,
            (first, second),
            recovered,
            camera,
            found.depth_std,
            found.log_factor,
            interpolated,
            found.outlier,
            found.ambiguous,
            found.alternative,
        ),
        bending,
    )


def scales(problem: Problem, frame: np.ndarray, log_factor: np.ndarray) -> np.ndarray:
    """(E, P) conformal scales of the problem's edges between given surfaces, NaN where a pair is absent.

    Where the refinement found conformal factors, the log scale is their difference. Otherwise it comes from the metric
    rows, and with it the errors of the warps' derivatives.

    Args:
        problem: edges and warps.
        frame: (P, F, 6) variables of the surfaces.
        log_factor: (F, P) log conformal factors; zero in an isometric model, NaN where not estimated.
    """
    if np.nan_to_num(log_factor).any():
        a, b = problem.edges.T
        return np.where(problem.weight.T > 0, np.exp(log_factor[a] - log_factor[b]), np.nan)
    state = State(np.ascontiguousarray(frame), np.zeros((problem.n_points, problem.n_edges)))
    scaled = with_closed_form_scale(problem, state, METRIC_ONLY)
    return np.where(problem.weight > 0, np.exp(scaled.log_scale), np.nan).T


def _surfaces(
    points: np.ndarray,
    image: np.ndarray,
    terms: tuple[np.ndarray, np.ndarray],
    recovered: np.ndarray,
    camera: Camera,
    depth_std: np.ndarray,
    log_factor: np.ndarray,
    interpolated: np.ndarray,
    outlier: np.ndarray,
    ambiguous: np.ndarray | None = None,
    alternative: np.ndarray | None = None,
) -> Surfaces:
    if not recovered.any() or not np.isfinite(points[recovered]).all():
        raise ComputationError("the reconstruction holds no finite surface; check the tracks for gross errors")
    seen = recovered[..., None]
    first, second = terms
    return Surfaces(
        points=np.where(seen, points, np.nan),
        normals=np.where(seen, normals(image, first, camera), np.nan),
        depth=np.where(recovered, points[..., 2], np.nan),
        first_order=np.where(seen, first, np.nan),
        second_order=np.where(seen, second, np.nan),
        depth_std=np.where(recovered, depth_std, np.nan),
        log_factor=log_factor,
        interpolated=interpolated,
        outlier=outlier,
        ambiguous=np.zeros(len(points), dtype=int) if ambiguous is None else ambiguous,
        alternative=alternative,
    )
