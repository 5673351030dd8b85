"""Spline warps with least bending: the linear fit that starts the Schwarzian one.

The spline minimises

    (1/P) sum_p w_p |eta(x_p) - y_p|^2 + mu (1/A) int |eta_uu|^2 + 2 |eta_uv|^2 + |eta_vv|^2,

the thin-plate energy integrated exactly over the spline's cells (area A).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from connrsfm_graph.warps.banded import add_data
from connrsfm_graph.warps.basis import SplineGrid, axis_rows


def bending_band(grid: SplineGrid) -> np.ndarray:
    """(N, b + 1) band matrix B with c^T B c = mean thin-plate energy of the spline with control points c."""
    hu, hv = grid.step
    uu, uv, vv = _unit_bending(grid.n)
    return (uu / hu**4 + 2.0 * uv / (hu * hv) ** 2 + vv / hv**4) / (grid.n - 3) ** 2


def data_equations(
    grid: SplineGrid, points: np.ndarray, target: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations (band, right side) of the mean squared data term; arguments as in `fit_bending`."""
    band = np.zeros((2 * grid.n**2, grid.bandwidth + 1))
    right = np.zeros(2 * grid.n**2)
    first, rows = grid.rows(points)
    add_data(band, right, first, np.ascontiguousarray(rows[:, 0]), weight / len(points), target, grid.n)
    return band, right


def fit_bending(
    grid: SplineGrid, points: np.ndarray, target: np.ndarray, weight: np.ndarray, bending: float
) -> np.ndarray:
    """Control points (n * n, 2) of the spline of least bending.

    Args:
        grid: its control grid; covers the points.
        points: (P, 2) in image a.
        target: (P, 2) in image b.
        weight: (P,) non-negative.
        bending: mu, positive.
    """
    band, right = data_equations(grid, points, target, weight)
    factor = cholesky_banded((band + bending * bending_band(grid)).T, lower=True)
    return cho_solve_banded((factor, True), right).reshape(-1, 2)


@lru_cache(maxsize=8)
def _unit_bending(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bands of the integrals of f_uu^2, f_uv^2, f_vv^2 over unit cells, both components side by side."""
    gram = _axis_gram(n)
    width = 2 * (3 * n + 3) + 2

    def band(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        dense = np.kron(u, v)
        out = np.zeros((2 * n * n, width))
        for offset in range(3 * n + 4):
            diagonal = np.repeat(np.diagonal(dense, -offset), 2)
            out[: len(diagonal), 2 * offset] = diagonal
        return out

    return band(gram[2], gram[0]), band(gram[1], gram[1]), band(gram[0], gram[2])


def _axis_gram(n: int) -> np.ndarray:
    """(3, n, n) integrals of products of the basis functions, their first and their second derivatives."""
    node, quadrature = np.polynomial.legendre.leggauss(4)  # exact up to degree 7
    rows = axis_rows((node + 1.0) / 2.0)
    cell = np.einsum("q,qdi,qdj->dij", quadrature / 2.0, rows, rows)
    gram = np.zeros((3, n, n))
    for i in range(n - 3):
        gram[:, i : i + 4, i : i + 4] += cell
    return gram
