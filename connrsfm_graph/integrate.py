"""Step 3: from first-order terms to depth, image by image.

The first-order terms are the gradient of log beta (of beta itself for an orthographic camera), so that integration is
linear. Two ways:

- `spline`: a bicubic B-spline over the image whose gradient fits the terms, with bending energy; its weight is fixed
  (paper mode) or chosen for the whole sequence by generalised cross-validation. It also interpolates points that have
  no terms of their own and smooths those that have.
- `graph`: log-depth differences along Delaunay edges as native GTSAM factors (`factors.depth_gradient`), second-order
  accurate with the second-order terms; no smoothing.

Depth is found up to one scale per image. `balance_scales` fixes it so that the median conformal scale of the image
graph's edges is 1 as nearly as a least-squares fit can make it, with mean log depth 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import Delaunay

from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.problem import Problem, State
from connrsfm_graph.surface_spline import SurfaceSpline, choose_bending, solve_all
from connrsfm_graph.warps.basis import U, V
from factors.depth_gradient import depth_graph, solve_depth


@dataclass(frozen=True)
class IntegrationConfig:
    """Integration of the first-order terms."""

    method: Literal["spline", "graph"] = "spline"
    """B-spline over the image, or native GTSAM factors between neighbouring points."""
    bending: float | None = None
    """Weight of the spline's bending energy; none: chosen by generalised cross-validation."""
    control_points: int = 14
    """Control points of the spline per axis, at most; fewer for few points."""
    huber: float = 2.0
    """Robust threshold on the terms' residual, in units of its median absolute deviation; spline only."""

    def __post_init__(self) -> None:
        if self.bending is not None and not 0 <= self.bending < np.inf:
            raise InputError(f"integrate.bending is {self.bending}, expected a number from 0, or none")
        if not 5 <= self.control_points <= 40:
            raise InputError(f"integrate.control_points is {self.control_points}, expected 5 to 40")
        if not self.huber > 0:
            raise InputError(f"integrate.huber is {self.huber}, expected a positive number")


@dataclass(frozen=True)
class Integrated:
    """Depth of every visible point."""

    log_depth: np.ndarray
    """(P, F); mean zero over the visible points of an image, 0 where not visible."""
    first_order: np.ndarray
    """(P, F, 2) gradient of the integrated surface."""
    second_order: np.ndarray
    """(P, F, 3) its second-order terms (depth's second derivatives over depth)."""
    bending: float
    """Bending weight used; 0 for the graph."""


def integrate(
    problem: Problem, state: State, config: IntegrationConfig = IntegrationConfig(), weight: np.ndarray | None = None
) -> Integrated:
    """Integrate the first-order terms of every image.

    Args:
        problem: image points, visibility and which points have terms of their own (`problem.constrained`).
        state: first- and second-order terms.
        config: settings.
        weight: (P, F) weight of each point's terms; 1 by default.

    Raises:
        ComputationError: an image has fewer than three points with first-order terms.
    """
    known = problem.constrained() & problem.visible
    few = np.flatnonzero(known.sum(axis=0) < 3)
    if len(few):
        raise ComputationError(
            f"image {few[0]} has {known[:, few[0]].sum()} points with first-order terms, integration needs 3: "
            "give it more tracks shared with other images, or leave it out"
        )
    if config.method == "graph":
        return _integrate_graph(problem, state, known)
    splines, bending = smoothing_splines(problem, state, config, weight)
    log_depth = np.zeros(problem.visible.shape)
    first, second = np.zeros((*log_depth.shape, 2)), np.zeros((*log_depth.shape, 3))
    for j, spline in enumerate(splines):
        seen = problem.visible[:, j]
        depth, first[seen, j], second[seen, j] = spline.surface(problem.image[seen, j], bending)
        log_depth[seen, j] = depth - depth.mean()
    return Integrated(log_depth, first, second, bending)


def smoothing_splines(
    problem: Problem, state: State, config: IntegrationConfig, weight: np.ndarray | None = None
) -> tuple[list[SurfaceSpline], float]:
    """The solved splines of all images whose gradients fit the first-order terms, and their bending weight.

    Args:
        problem, state, config, weight: as in `integrate`.
    """
    known = problem.constrained() & problem.visible
    weight = np.where(known, 1.0 if weight is None else weight, 0.0)
    systems = []
    for j in range(problem.n_frames):
        used, seen = weight[:, j] > 0, problem.visible[:, j]
        systems.append(
            SurfaceSpline(
                problem.image[used, j],
                (U, V),
                state.first_order[used, j],
                weight[used, j],
                problem.image[seen, j],
                config.control_points,
                problem.camera,
            )
        )
    bending = choose_bending(systems) if config.bending is None else config.bending
    solve_all(systems, bending)
    for _ in range(3 if np.isfinite(config.huber) else 0):
        spread = 1.4826 * np.median(np.concatenate([system.residual_norms(bending) for system in systems]))
        for system in systems:
            system.reweight(config.huber * spread, bending)
        solve_all(systems, bending)
    return systems, bending


def balance_scales(problem: Problem, state: State) -> State:
    """Scale every image's depths so that the median log conformal scale of each edge is 0 in the least-squares sense.

    Log scales change with the depths, so that the pair factors keep their value; the mean log depth becomes 0. The
    depths of orthographic cameras have no scale and stay.
    """
    if not problem.camera.kappa:
        return state
    present = problem.weight > 0
    a, b = problem.edges.T
    used = np.flatnonzero(present.any(axis=0))
    medians = np.array([np.median(state.log_scale[present[:, e], e]) for e in used])
    incidence = np.zeros((len(used), problem.n_frames))
    incidence[np.arange(len(used)), a[used]] = 1.0
    incidence[np.arange(len(used)), b[used]] = -1.0
    laplacian = incidence.T @ incidence + np.full((problem.n_frames,) * 2, 1.0 / problem.n_frames)
    # Adding t_j to the log depths of image j adds t_a - t_b to the log scales of edge (a, b).
    offset = np.linalg.lstsq(laplacian, -incidence.T @ medians)[0]
    offset -= (state.log_depth + offset)[problem.visible].mean()
    return state.updated(
        log_depth=np.where(problem.visible, state.log_depth + offset, 0.0),
        log_scale=np.where(present, state.log_scale + offset[a] - offset[b], 0.0),
    )


def _integrate_graph(problem: Problem, state: State, known: np.ndarray) -> Integrated:
    log_depth = np.zeros(problem.visible.shape)
    for j in range(problem.n_frames):
        points = np.flatnonzero(known[:, j])
        image = problem.image[points, j]
        graph = depth_graph(
            image,
            state.first_order[points, j],
            state.second_order[points, j],
            delaunay_edges(image),
            points,
            j,
            problem.camera,
        )
        log_depth[points, j] = solve_depth(graph, points, j)
    return Integrated(log_depth, state.first_order, state.second_order, 0.0)


def delaunay_edges(image: np.ndarray) -> np.ndarray:
    """(N, 2) edges of the Delaunay triangulation of image points (P, 2), each once; coinciding points are tied."""
    triangles = Delaunay(image, qhull_options="QJ Pp").simplices
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(sides, axis=0)
