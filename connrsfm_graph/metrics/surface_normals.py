"""Normals of a bicubic B-spline refitted to points: how the field measures the error of a shape.

The spline is a map S from the image plane to 3D that minimises

    sum_i |S(x_i) - X_i|^2 + bending * integral |S_uu|^2 + 2 |S_uv|^2 + |S_vv|^2

over the bounding box of the x_i, widened on every side by a border in normalised image coordinates. Number of control
points, bending and border are those of the code published with the isometric methods (Parashar, Pizarro, Bartoli,
PAMI 2018), so that figures compare; the integral is in normalised image coordinates as there.

The data term is a sum over points and not a mean, and the integral is not divided by the area: few points on a curved
surface are smoothed more than many. On 100 points of spherical caps this alone costs 0.8 degrees (35-degree caps) and
1.6 degrees (55-degree caps) for the exact truth, most of it at the border; `Evaluation.shape_floor_deg` reports it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from connrsfm_graph.warps.basis import VALUE, SplineGrid, U, V, axis_rows

CONTROL_POINTS = 40
"""Per side."""


@dataclass(frozen=True)
class Refit:
    """How a spline is refitted to points."""

    bending: float
    """Weight of the bending energy."""
    border: float
    """Widening of the bounding box on every side, in normalised image coordinates."""


RECONSTRUCTION = Refit(bending=1e-4, border=0.1)
TRUTH = Refit(bending=1e-5, border=1e-3)


def surface_normals(image: np.ndarray, points: np.ndarray, refit: Refit) -> np.ndarray:
    """Unit normals (P, 3) of the surface refitted to points, at these points, towards the camera.

    Args:
        image: (P, 2) where the surface is parametrised; at least three points not on a line.
        points: (P, 3) points of the surface; axes right, down, forward.
        refit: smoothing.
    """
    lower = image.min(axis=0) - refit.border
    step = (np.ptp(image, axis=0) + 2 * refit.border) / (CONTROL_POINTS - 3)
    cell, rows = SplineGrid(CONTROL_POINTS, lower, step).rows(image)
    column = cell[:, None] + (CONTROL_POINTS * np.arange(4)[:, None] + np.arange(4)).ravel()
    shape = (len(image), CONTROL_POINTS**2)
    value = sparse.csr_array((rows[:, VALUE].ravel(), column.ravel(), 16 * np.arange(len(image) + 1)), shape)
    normal_matrix = value.T @ value + refit.bending * _bending_energy(step)
    solver = splu(normal_matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    control = solver.solve(value.T @ points)[column]
    along_u, along_v = (np.einsum("pk,pkd->pd", rows[:, order], control) for order in (U, V))
    normal = np.cross(along_v, along_u)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _bending_energy(step: np.ndarray) -> sparse.csr_array:
    """Matrix of the quadratic form integral S_uu^2 + 2 S_uv^2 + S_vv^2 over all cells."""
    uu, uv, vv = _unit_bending_energy()
    u, v = step
    return v / u**3 * uu + 2.0 / (u * v) * uv + u / v**3 * vv


@cache
def _unit_bending_energy() -> tuple[sparse.csr_array, sparse.csr_array, sparse.csr_array]:
    """Its three parts for cells of unit size: products of the basis' Gram matrices along either axis."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    basis = axis_rows((nodes + 1) / 2)  # four nodes integrate the products, of degree 6 at most, exactly
    cell = np.einsum("q,qdi,qdj->dij", weights / 2, basis, basis)
    gram = np.zeros((3, CONTROL_POINTS, CONTROL_POINTS))
    for k in range(CONTROL_POINTS - 3):
        gram[:, k : k + 4, k : k + 4] += cell
    value, first, second = (sparse.csr_array(matrix) for matrix in gram)
    return tuple(sparse.csr_array(sparse.kron(*pair)) for pair in ((second, value), (first, first), (value, second)))
