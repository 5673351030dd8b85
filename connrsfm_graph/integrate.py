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
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import Delaunay
from scipy.linalg import cho_solve, cholesky, eigh, solve_triangular

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.problem import Problem, State
from connrsfm_graph.warps.basis import UU, UV, VV, SplineGrid, U, V
from factors.depth_gradient import depth_graph, solve_depth
from factors.surface import Camera

PADDING = 0.05
"""Margin of the spline's grid around the points, relative to their extent."""
SMOOTHINGS = np.logspace(-9, 1, 61)
"""Bending weights among which cross-validation chooses."""


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
    weight = np.where(known, 1.0 if weight is None else weight, 0.0)
    frames = range(problem.n_frames)
    systems = [_GradientSystem(problem, state, j, weight[:, j], config) for j in frames]
    bending = choose_bending(systems) if config.bending is None else config.bending
    for _ in range(3 if np.isfinite(config.huber) else 0):
        spread = 1.4826 * np.median(np.concatenate([system.residual_norms(bending) for system in systems]))
        for system in systems:
            system.reweight(config.huber * spread, bending)
    log_depth = np.zeros(problem.visible.shape)
    first, second = np.zeros((*log_depth.shape, 2)), np.zeros((*log_depth.shape, 3))
    for j, system in enumerate(systems):
        seen = problem.visible[:, j]
        log_depth[seen, j], first[seen, j], second[seen, j] = system.surface(problem.image[seen, j], bending)
    return Integrated(log_depth, first, second, bending)


class _Spectrum(NamedTuple):
    """Normal equations diagonalised for every bending weight at once: (A^T W A + mu B)^-1 = V (1 + mu gamma)^-1 V^T."""

    vectors: np.ndarray
    gamma: np.ndarray
    right: np.ndarray


class _GradientSystem:
    """Spline of one image whose gradient fits the first-order terms."""

    def __init__(self, problem: Problem, state: State, frame: int, weight: np.ndarray, config: IntegrationConfig):
        used = weight > 0
        self.image = problem.image[used, frame]
        self.terms = state.first_order[used, frame]
        self.weight = weight[used]
        self.camera = problem.camera
        n = int(np.clip(3 + np.ceil(np.sqrt(used.sum())), 5, config.control_points))
        self.grid = SplineGrid.around(problem.image[problem.visible[:, frame], frame], n, PADDING)
        self.extent = float(np.sqrt(self.grid.area))
        first, rows = self.grid.rows(self.image)
        self.columns = first[:, None] + self.grid.patch()
        # Gradients in units of the image's extent, so that the bending weight does not depend on units.
        self.rows = rows[:, (U, V)] * self.extent
        self.target = self.terms * self.extent
        self.bending = _bending_matrix(self.grid) * self.extent**2
        self.robust = np.ones(len(self.weight))
        self._spectrum: _Spectrum | None = None

    def design(self) -> np.ndarray:
        """(2 N, n^2) dense gradient rows."""
        N = len(self.columns)
        A = np.zeros((N, 2, self.grid.n**2))
        A[np.arange(N)[:, None, None], np.arange(2)[:, None], self.columns[:, None, :]] = self.rows
        return A.reshape(2 * N, -1)

    def spectrum(self) -> _Spectrum:
        if self._spectrum is None:
            A = self.design()
            w = np.repeat(self.weight * self.robust, 2)
            normal = A.T @ (w[:, None] * A)
            scale = np.trace(normal) / len(normal)
            # The ridge holds the constant and the control points that no point sees; it is far below either term.
            ridge = SMOOTHINGS[0] * self.bending + 1e-10 * scale * np.eye(len(normal))
            lower = cholesky(normal + ridge, lower=True)
            gamma, vectors = eigh(
                solve_triangular(lower, solve_triangular(lower, self.bending, lower=True).T, lower=True)
            )
            vectors = solve_triangular(lower.T, vectors)
            self._spectrum = _Spectrum(vectors, np.maximum(gamma, 0.0), vectors.T @ (A.T @ (w * self.target.ravel())))
        return self._spectrum

    def control(self, bending: float) -> np.ndarray:
        """(n^2,) control points for a bending weight."""
        s = self.spectrum()
        return s.vectors @ (s.right / (1.0 + bending * s.gamma))

    def residuals(self, control: np.ndarray) -> np.ndarray:
        """(N, 2) misfit of the gradient, in units of the extent."""
        return np.einsum("pdk,pk->pd", self.rows, control[self.columns]) - self.target

    def residual_norms(self, bending: float) -> np.ndarray:
        return np.linalg.norm(self.residuals(self.control(bending)), axis=1)

    def score(self, bending: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Weighted residual sum of squares and effective number of parameters for each bending weight, and 2 N."""
        s = self.spectrum()
        total = float((np.repeat(self.weight * self.robust, 2) * self.target.ravel() ** 2).sum())
        shrink = 1.0 / (1.0 + bending[:, None] * s.gamma)
        # In the spectral basis A^T W A is the identity up to the ridge.
        rss = total - (s.right**2 * (2 * shrink - shrink**2)).sum(axis=1)
        return np.maximum(rss, 0.0), shrink.sum(axis=1), self.target.size

    def reweight(self, threshold: float, bending: float) -> None:
        """Huber weights from the present fit."""
        norms = self.residual_norms(bending)
        self.robust = np.minimum(1.0, threshold / np.maximum(norms, 1e-300))
        self._spectrum = None

    def surface(self, image: np.ndarray, bending: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log depth (mean zero), first- and second-order terms at image points."""
        jet = self.grid.evaluate(self.control(bending)[:, None], image)[..., 0]
        first, second = jet[:, (U, V)], jet[:, (UU, UV, VV)]
        return jet[:, 0] - jet[:, 0].mean(), first, _terms_of_log(first, second, self.camera)


def choose_bending(systems: list[_GradientSystem]) -> float:
    """Bending weight of least generalised cross-validation score over all images."""
    scores = [system.score(SMOOTHINGS) for system in systems]
    rss = sum(score[0] for score in scores)
    parameters = sum(score[1] for score in scores)
    size = sum(score[2] for score in scores)
    free = np.maximum(1.0 - parameters / size, 1e-3)
    return float(SMOOTHINGS[np.argmin(rss / free**2)])


def balance_scales(problem: Problem, state: State) -> State:
    """Scale every image's depths so that the median log conformal scale of each edge is 0 in the least-squares sense.

    Log scales change with the depths, so that the pair factors keep their value; the mean log depth becomes 0.
    """
    present = problem.weight > 0
    a, b = problem.edges.T
    used = np.flatnonzero(present.any(axis=0))
    medians = np.array([np.median(state.log_scale[present[:, e], e]) for e in used])
    incidence = np.zeros((len(used), problem.n_frames))
    incidence[np.arange(len(used)), a[used]] = 1.0
    incidence[np.arange(len(used)), b[used]] = -1.0
    laplacian = incidence.T @ incidence + np.full((problem.n_frames,) * 2, 1.0 / problem.n_frames)
    # Adding t_j to the log depths of image j adds t_a - t_b to the log scales of edge (a, b).
    offset = cho_solve((cholesky(laplacian + 1e-12 * np.eye(problem.n_frames), lower=True), True), -incidence.T @ medians)
    offset -= (state.log_depth + offset)[problem.visible].mean()
    return state.updated(
        log_depth=np.where(problem.visible, state.log_depth + offset, 0.0),
        log_scale=np.where(present, state.log_scale + offset[a] - offset[b], 0.0),
    )


def _terms_of_log(first: np.ndarray, second: np.ndarray, camera: Camera) -> np.ndarray:
    """Second-order terms of depth from derivatives of log depth (perspective) or of depth (orthographic)."""
    y1, y2 = first.T
    return second + camera.kappa * np.stack([y1 * y1, y1 * y2, y2 * y2], axis=-1)


def _bending_matrix(grid: SplineGrid) -> np.ndarray:
    """(n^2, n^2) integral of S_uu^2 + 2 S_uv^2 + S_vv^2 over the grid, four Gauss points per cell and axis."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    rows = grid.cell_rows((nodes + 1) / 2)
    area = np.outer(weights, weights).ravel() / 4 * np.prod(grid.step)
    cell = sum(
        factor * np.einsum("q,qi,qj->ij", area, rows[:, order], rows[:, order])
        for factor, order in ((1.0, UU), (2.0, UV), (1.0, VV))
    )
    matrix = np.zeros((grid.n**2, grid.n**2))
    starts = (np.arange(grid.n - 3)[:, None] * grid.n + np.arange(grid.n - 3)).ravel()
    for start in starts:
        index = start + grid.patch()
        matrix[np.ix_(index, index)] += cell
    return matrix


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
