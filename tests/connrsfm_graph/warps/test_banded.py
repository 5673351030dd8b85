"""Band matrices against the dense matrices they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import cholesky_banded

from connrsfm_graph.warps.banded import add_data, inverse_in_band, patch_blocks, times
from connrsfm_graph.warps.basis import VALUE, SplineGrid
from connrsfm_graph.warps.bending import bending_band, data_equations

GRID = SplineGrid(6, np.array([-1.0, -1.0]), np.array([0.7, 0.6]))
RNG = np.random.default_rng(1)
POINTS = GRID.origin + GRID.step * 3 * RNG.uniform(0, 1, (25, 2))
WEIGHT = RNG.uniform(0.5, 1.0, 25)
TARGET = RNG.normal(size=(25, 2))


def dense(band: np.ndarray) -> np.ndarray:
    full = np.zeros((len(band), len(band)))
    for offset in range(band.shape[1]):
        size = len(band) - offset
        if size > 0:
            full += np.diag(band[:size, offset], -offset)
    return full + np.tril(full, -1).T


@pytest.fixture
def band() -> np.ndarray:
    return data_equations(GRID, POINTS, TARGET, WEIGHT)[0] + 0.01 * bending_band(GRID)


def test_data_equations_are_the_normal_equations():
    first, rows = GRID.rows(POINTS)
    design = np.zeros((25, 2, 72))
    for p in range(25):
        for k in range(16):
            column = first[p] + (k // 4) * 6 + k % 4
            design[p, 0, 2 * column] = design[p, 1, 2 * column + 1] = rows[p, VALUE, k]
    band, right = np.zeros((72, GRID.bandwidth + 1)), np.zeros(72)
    add_data(band, right, first, np.ascontiguousarray(rows[:, VALUE]), WEIGHT, TARGET, 6)
    np.testing.assert_allclose(dense(band), np.einsum("pci,p,pcj->ij", design, WEIGHT, design), atol=1e-12)
    np.testing.assert_allclose(right, np.einsum("pci,p,pc->i", design, WEIGHT, TARGET), atol=1e-12)


def test_product_with_a_vector(band):
    x = RNG.normal(size=len(band))
    np.testing.assert_allclose(times(band, x), dense(band) @ x, atol=1e-10)


def test_inverse_inside_the_band(band):
    lower = np.ascontiguousarray(cholesky_banded(band.T, lower=True).T)
    inverse = np.linalg.inv(dense(band))
    computed = inverse_in_band(lower)
    for offset in range(band.shape[1]):
        size = max(len(band) - offset, 0)
        np.testing.assert_allclose(computed[:size, offset], np.diagonal(inverse, -offset), rtol=1e-7, atol=1e-9)


def test_patch_blocks_pick_the_control_points_of_each_row(band):
    first, _ = GRID.rows(POINTS)
    full = dense(band)
    for p, block in enumerate(patch_blocks(band, first, 6)):
        control = first[p] + GRID.patch()
        index = (2 * control[:, None] + np.arange(2)).ravel()
        np.testing.assert_array_equal(block, full[np.ix_(index, index)])
