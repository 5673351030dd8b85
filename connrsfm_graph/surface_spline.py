"""Smoothing splines over one image: a function of the image known by its values or its gradients at some points."""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from scipy.linalg import cho_solve, cholesky, solve_triangular

from connrsfm_graph.threads import mapped
from connrsfm_graph.warps.basis import UU, UV, VALUE, VV, SplineGrid, U, V
from factors.surface import Camera

PADDING = 0.05
"""Margin of the spline's grid around the points, relative to their extent."""
SMOOTHINGS = np.logspace(-9, 1, 61)
"""Bending weights among which cross-validation chooses."""
SCORED = 16
"""Images on which it tries them, at most."""


class SurfaceSpline:
    """Spline over one image that fits log depth or its gradient at the image's points, for any bending weight.

    Derivatives are taken in units of the image's extent, so that the bending weight does not depend on units.
    """

    def __init__(
        self,
        image: np.ndarray,
        orders: tuple[int, ...],
        target: np.ndarray,
        weight: np.ndarray,
        cover: np.ndarray,
        control_points: int,
        camera: Camera,
    ):
        """Fit derivatives `orders` to `target` (N, len(orders)) at `image` (N, 2), on a grid that covers `cover`."""
        self.weight = weight
        self.camera = camera
        n = int(np.clip(3 + np.ceil(np.sqrt(len(image))), 5, control_points))
        self.grid = SplineGrid.around(cover, n, PADDING)
        extent = float(np.sqrt(self.grid.area))
        self.unit = np.array([extent if order in (U, V) else 1.0 for order in orders])
        first, rows = self.grid.rows(image)
        self.columns = first[:, None] + self.grid.patch()
        self.rows = rows[:, orders] * self.unit[:, None]
        self.target = target * self.unit
        self.bending = bending_matrix(self.grid) * extent**2
        self.robust = np.ones(len(weight))
        self._control: tuple[float, np.ndarray] | None = None

    def normal_equations(self) -> tuple[np.ndarray, np.ndarray]:
        """(n^2, n^2) normal matrix of the data, lower triangle, and right-hand side."""
        # A ridge far below the data holds what no point sees: the constant and distant control points.
        normal, right = SMOOTHINGS[0] * self.bending, np.zeros(len(self.bending))
        weight = self.weight * self.robust
        trace = np.einsum("p,pdk,pdk->", weight, self.rows, self.rows)
        normal[np.diag_indices_from(normal)] += 1e-10 * trace / len(normal)
        _add_products(self.columns, self.rows, self.target, weight, normal, right)
        return normal, right

    def control(self, bending: float) -> np.ndarray:
        """(n^2,) control points for a bending weight."""
        if self._control is None or self._control[0] != bending:
            normal, right = self.normal_equations()
            normal += bending * self.bending
            lower = cholesky(normal, lower=True, overwrite_a=True, check_finite=False)
            self._control = bending, cho_solve((lower, True), right, check_finite=False)
        return self._control[1]

    def control_covariance(self, bending: float, covariance: np.ndarray) -> np.ndarray:
        """(n^2, n^2) covariance of the control points.

        Args:
            bending: weight of the bending energy.
            covariance: (N, orders, orders) of the target at every point, in its own unit; points are independent.
        """
        normal, _ = self.normal_equations()
        N, orders = self.target.shape
        A = np.zeros((N, orders, len(normal)))
        A[np.arange(N)[:, None, None], np.arange(orders)[:, None], self.columns[:, None]] = self.rows
        A *= (self.weight * self.robust)[:, None, None]
        spread = np.einsum("nde,nek->ndk", covariance * self.unit[:, None] * self.unit, A)
        middle = A.reshape(N * orders, -1).T @ spread.reshape(N * orders, -1)
        factor = cholesky(normal + bending * self.bending, lower=True), True
        return np.asarray(cho_solve(factor, cho_solve(factor, middle).T))

    def residual_norms(self, bending: float) -> np.ndarray:
        """(N,) misfit of every point."""
        fitted = np.einsum("pdk,pk->pd", self.rows, self.control(bending)[self.columns])
        return np.linalg.norm(fitted - self.target, axis=1)

    def score(self, bending: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Weighted residual sum of squares and effective number of parameters for each bending weight; rows.

        Diagonalising both quadratic forms together, (normal + mu bending)^-1 = V (1 + mu gamma)^-1 V^T, serves all
        weights at once; in that basis the data's normal matrix is the identity up to the ridge.
        """
        normal, right = self.normal_equations()
        lower = cholesky(normal, lower=True)
        half = solve_triangular(lower, self.bending, lower=True)
        gamma, vectors = np.linalg.eigh(solve_triangular(lower, half.T, lower=True))
        right = vectors.T @ solve_triangular(lower, right, lower=True)
        total = float(((self.weight * self.robust)[:, None] * self.target**2).sum())
        shrink = 1.0 / (1.0 + bending[:, None] * np.maximum(gamma, 0.0))
        rss = total - (right**2 * (2 * shrink - shrink**2)).sum(axis=1)
        return np.maximum(rss, 0.0), shrink.sum(axis=1), self.target.size

    def reweight(self, threshold: float, bending: float) -> None:
        """Huber weights from the present fit."""
        self.robust = np.minimum(1.0, threshold / np.maximum(self.residual_norms(bending), 1e-300))
        self._control = None

    def values(self, image: np.ndarray) -> np.ndarray:
        """(N, n^2) dense rows that give the function at image points."""
        first, rows = self.grid.rows(image)
        dense = np.zeros((len(image), self.grid.n**2))
        np.put_along_axis(dense, first[:, None] + self.grid.patch(), rows[:, VALUE], axis=1)
        return dense

    def surface(self, image: np.ndarray, bending: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fitted function, first- and second-order terms of the surface at image points."""
        jet = self.grid.evaluate(self.control(bending)[:, None], image)[..., 0]
        first, second = jet[:, (U, V)], jet[:, (UU, UV, VV)]
        return jet[:, 0], first, _terms_of_log(first, second, self.camera)


@njit(cache=True, nogil=True)
def _add_products(columns, rows, target, weight, normal, right):
    """Add weight_p |rows_p c[columns_p] - target_p|^2 to the normal equations of c, lower triangle.

    Args:
        columns: (N, 16) ascending.
        rows: (N, D, 16).
        target: (N, D).
        weight: (N,).
        normal, right: (M, M) and (M,), changed in place.
    """
    for p in range(len(columns)):
        at = columns[p]
        for d in range(rows.shape[1]):
            row = rows[p, d]
            for k in range(16):
                scaled = weight[p] * row[k]
                right[at[k]] += scaled * target[p, d]
                for m in range(k + 1):
                    normal[at[k], at[m]] += scaled * row[m]


def terms_of_depth(
    image: np.ndarray,
    log_depth: np.ndarray,
    known: np.ndarray,
    camera: Camera,
    bending: float | None = None,
    control_points: int = 14,
) -> tuple[np.ndarray, np.ndarray, float]:
    """First- (F, P, 2) and second-order terms (F, P, 3) of surfaces given by their depths, by smoothing splines.

    Args:
        image: (F, P, 2) normalised coordinates of the surface points, finite where known.
        log_depth: (F, P); of an orthographic camera depth itself.
        known: (F, P) bool; at least three points per image. Terms are 0 elsewhere.
        camera: camera model.
        bending: weight of the bending energy; chosen by cross-validation where None.
        control_points: of the spline per axis, at most.

    Returns:
        The terms and the bending weight.
    """
    splines = list(
        mapped(
            lambda j: SurfaceSpline(
                image[j, known[j]],
                (VALUE,),
                log_depth[j, known[j]][:, None],
                np.ones(known[j].sum()),
                image[j, known[j]],
                control_points,
                camera,
            ),
            range(len(known)),
        )
    )
    chosen = choose_bending(splines) if bending is None else bending
    first, second = np.zeros((*known.shape, 2)), np.zeros((*known.shape, 3))

    def evaluate(j: int) -> None:
        _, first[j, known[j]], second[j, known[j]] = splines[j].surface(image[j, known[j]], chosen)

    for _ in mapped(evaluate, range(len(known))):
        pass
    return first, second, chosen


def solve_all(systems: list[SurfaceSpline], bending: float) -> None:
    """Solve for the control points of all images, in threads; the splines keep them."""
    for _ in mapped(lambda system: system.control(bending), systems):
        pass


def choose_bending(systems: list[SurfaceSpline]) -> float:
    """Bending weight of least generalised cross-validation score over up to `SCORED` images spread over all."""
    some = np.unique(np.linspace(0, len(systems) - 1, min(len(systems), SCORED)).round().astype(int))
    scores = list(mapped(lambda j: systems[j].score(SMOOTHINGS), some))
    rss = sum(score[0] for score in scores)
    parameters = sum(score[1] for score in scores)
    size = sum(score[2] for score in scores)
    free = np.maximum(1.0 - parameters / size, 1e-3)
    return float(SMOOTHINGS[np.argmin(rss / free**2)])


def _terms_of_log(first: np.ndarray, second: np.ndarray, camera: Camera) -> np.ndarray:
    """Second-order terms of depth from derivatives of log depth (perspective) or of depth (orthographic)."""
    y1, y2 = first.T
    return second + camera.kappa * np.stack([y1 * y1, y1 * y2, y2 * y2], axis=-1)


def bending_matrix(grid: SplineGrid) -> np.ndarray:
    """(n^2, n^2) integral of S_uu^2 + 2 S_uv^2 + S_vv^2 over the grid."""
    uu, uv, vv = _unit_bending(grid.n)
    hu, hv = grid.step
    return hu * hv * (uu / hu**4 + 2.0 * uv / (hu * hv) ** 2 + vv / hv**4)


@cache
def _unit_bending(n: int) -> tuple[np.ndarray, ...]:
    """(n^2, n^2) integrals of S_uu^2, S_uv^2 and S_vv^2 over a grid of unit cells, four Gauss points each and axis."""
    grid = SplineGrid(n, np.zeros(2), np.ones(2))
    nodes, weights = np.polynomial.legendre.leggauss(4)
    rows = grid.cell_rows((nodes + 1) / 2)
    area = np.outer(weights, weights).ravel() / 4
    first = (np.arange(n - 3)[:, None] * n + np.arange(n - 3)).reshape(-1, 1, 1)
    row, column = first + grid.patch()[:, None], first + grid.patch()
    matrices = []
    for order in (UU, UV, VV):
        matrix = np.zeros((n**2, n**2))
        np.add.at(matrix, (row, column), np.einsum("q,qi,qj->ij", area, rows[:, order], rows[:, order]))
        matrices.append(matrix)
    return tuple(matrices)
