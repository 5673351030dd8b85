"""Spline warps with the 2D Schwarzian penalty ("Schwarps": Pizarro, Khan, Bartoli, IJCV 2016).

The image of a plane moves by a homography, and a smooth surface is nearly planar around every point; a warp should
therefore be a homography locally. For eta = (f, g) the four Schwarzian equations

    S1 = f_uu g_u - g_uu f_u,    S3 = f_uu g_v - g_uu f_v + 2 (f_uv g_u - g_uv f_u),
    S2 = f_vv g_v - g_vv f_v,    S4 = f_vv g_u - g_vv f_u + 2 (f_uv g_v - g_uv f_v)

vanish exactly for homographies, while any bending energy also punishes perspective. The fit minimises

    (1/P) sum_p w_p |eta(x_p) - y_p|^2 + lambda (1/A) int |S|^2 + mu (1/A) int bending,

with a bending weight mu too small to matter where there are points: it holds the cells without any. Products of two
derivatives make S bilinear, so Gauss-Newton with a step-halving safeguard converges in a few iterations.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.linalg import cho_solve_banded, cholesky_banded

from connrsfm_graph.warps.banded import times
from connrsfm_graph.warps.basis import UU, UV, VV, SplineGrid, U, V
from connrsfm_graph.warps.bending import bending_band, data_equations

# Equation by equation: second derivative, first derivative and factor of its two products (the first two have one).
_TERMS = (
    ((UU, U, 1.0), (UU, U, 0.0)),
    ((VV, V, 1.0), (VV, V, 0.0)),
    ((UU, V, 1.0), (UV, U, 2.0)),
    ((VV, U, 1.0), (UV, V, 2.0)),
)
_MAX_HALVINGS = 10
# Two Gauss nodes per axis and cell.
_NODES = np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)])


def schwarzian(derivatives: np.ndarray) -> np.ndarray:
    """(..., 4) Schwarzian equations of a warp from its (..., 6, 2) value, u, v, uu, uv, vv."""
    f, g = derivatives[..., 0], derivatives[..., 1]

    def product(second: int, one: int) -> np.ndarray:
        return f[..., second] * g[..., one] - g[..., second] * f[..., one]

    return np.stack([sum(factor * product(i, j) for i, j, factor in terms) for terms in _TERMS], axis=-1)


def fit_schwarzian(
    grid: SplineGrid,
    points: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    penalty: float,
    bending: float,
    start: np.ndarray,
    max_steps: int = 30,
    tolerance: float = 1e-4,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Spline of least Schwarzian penalty.

    Args:
        grid: its control grid; covers the points.
        points, target: (P, 2) in image a and in image b.
        weight: (P,) non-negative.
        penalty, bending: lambda and mu.
        start: (n * n, 2) control points to start from.
        max_steps: Gauss-Newton steps at most.
        tolerance: stop once a step lowers the cost by less than this fraction of it.

    Returns:
        control: (n * n, 2) control points.
        lower: (N, b + 1) Cholesky factor of the Gauss-Newton matrix at the solution, in band storage.
        steps: Gauss-Newton steps taken.
    """
    fixed, right = data_equations(grid, points, target, weight)
    fixed += bending * bending_band(grid)
    at_zero = float((weight[:, None] * target**2).sum() / len(points))
    cell_rows = np.ascontiguousarray(grid.cell_rows(_NODES))
    node_weight = penalty / (len(cell_rows) * (grid.n - 3) ** 2)

    def linearise(control: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, half its gradient and the Gauss-Newton matrix."""
        gradient = times(fixed, control) - right
        cost = control @ (gradient - right) + at_zero
        band = fixed.copy()
        cost += add_schwarzian(band, gradient, cell_rows, node_weight, grid.n, control)
        return cost, gradient, band

    control = start.reshape(-1)
    cost, gradient, band = linearise(control)
    steps = 0
    while steps < max_steps:
        steps += 1
        factor = cholesky_banded(band.T, lower=True)
        step = cho_solve_banded((factor, True), gradient)
        for _ in range(_MAX_HALVINGS):
            trial_cost, trial_gradient, trial_band = linearise(control - step)
            if trial_cost <= cost:
                break
            step *= 0.5
        else:
            break
        converged = cost - trial_cost <= tolerance * cost
        control, cost, gradient, band = control - step, trial_cost, trial_gradient, trial_band
        if converged:
            break
    lower = cholesky_banded(band.T, lower=True)
    return control.reshape(-1, 2), np.ascontiguousarray(lower.T), steps


@njit(cache=True)
def add_schwarzian(
    band: np.ndarray, gradient: np.ndarray, cell_rows: np.ndarray, weight: float, n: int, control: np.ndarray
) -> float:
    """Add `weight` times the sum of |S|^2 over the nodes of all cells; returns that sum times `weight`.

    Args:
        band, gradient: (N, b + 1) Gauss-Newton matrix and (N,) half gradient, changed in place.
        cell_rows: (Q, 6, 16) rows at the nodes of a cell, the same for every cell.
        weight: of every node.
        n: control points per axis.
        control: (N,) control points, components side by side.
    """
    cost = 0.0
    index = np.empty(32, np.int64)
    eta = np.empty((6, 2))
    jacobian = np.empty((4, 32))
    block = np.empty((32, 32))
    for cell in range((n - 3) * (n - 3)):
        first = (cell // (n - 3)) * n + cell % (n - 3)
        for k in range(16):
            index[2 * k] = 2 * (first + (k // 4) * n + k % 4)
            index[2 * k + 1] = index[2 * k] + 1
        block[:] = 0.0
        for q in range(len(cell_rows)):
            rows = cell_rows[q]
            eta[:] = 0.0
            for d in range(1, 6):
                for k in range(16):
                    eta[d, 0] += rows[d, k] * control[index[2 * k]]
                    eta[d, 1] += rows[d, k] * control[index[2 * k + 1]]
            jacobian[:] = 0.0
            for equation in range(4):
                residual = 0.0
                for second, one, factor in _TERMS[equation]:
                    residual += factor * (eta[second, 0] * eta[one, 1] - eta[second, 1] * eta[one, 0])
                    for k in range(16):
                        jacobian[equation, 2 * k] += factor * (
                            rows[second, k] * eta[one, 1] - rows[one, k] * eta[second, 1]
                        )
                        jacobian[equation, 2 * k + 1] += factor * (
                            rows[one, k] * eta[second, 0] - rows[second, k] * eta[one, 0]
                        )
                cost += weight * residual * residual
                for k in range(32):
                    gradient[index[k]] += weight * residual * jacobian[equation, k]
                    for m in range(k + 1):
                        block[k, m] += jacobian[equation, k] * jacobian[equation, m]
        for k in range(32):
            for m in range(k + 1):
                band[index[m], index[k] - index[m]] += weight * block[k, m]
    return cost
