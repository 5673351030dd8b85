"""Schwarzian and bending splines: what their penalties measure and what their fits reproduce."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from connrsfm_graph.warps.basis import VALUE, SplineGrid
from connrsfm_graph.warps.bending import bending_band, fit_bending
from connrsfm_graph.warps.homography import Homography
from connrsfm_graph.warps.schwarzian import add_schwarzian, fit_schwarzian, schwarzian

RNG = np.random.default_rng(2)
POINTS = RNG.uniform(-1.5, 1.5, (200, 2))
ONES = np.ones(len(POINTS))
HOMOGRAPHY = Homography(np.array([[1.0, 0.2], [-0.1, 1.1]]), np.array([0.1, 0.0]), np.array([0.15, -0.1]))


def derivatives(homography: Homography, points: np.ndarray) -> np.ndarray:
    jet = homography.jet(points)
    first, second = np.moveaxis(jet.jacobian, -1, 1), np.moveaxis(jet.hessian, -1, 1)
    return np.concatenate([jet.value[:, None], first, second], axis=1)


numbers = st.floats(-0.3, 0.3)


@given(st.tuples(*[numbers] * 8))
def test_schwarzian_equations_vanish_for_homographies(p):
    homography = Homography(np.eye(2) + np.reshape(p[:4], (2, 2)), np.array(p[4:6]), np.array(p[6:]))
    assert np.abs(schwarzian(derivatives(homography, POINTS[:5]))).max() < 1e-10


def test_schwarzian_equations_see_a_quadratic_warp():
    quadratic = np.zeros((1, 6, 2))
    quadratic[0, 1:3] = np.eye(2)
    quadratic[0, 3:] = [[0.5, 0.0], [0.2, 0.3], [0.0, -0.4]]
    # f_u = g_v = 1, f_uu = 0.5, f_uv = 0.2, g_uv = 0.3, g_vv = -0.4 in S1 to S4.
    expected = [-0.0, 0.0, 0.5 - 2 * 0.3, 0.4 + 2 * 0.2]
    np.testing.assert_allclose(schwarzian(quadratic)[0], expected, atol=1e-15)


def test_penalty_gradient_matches_finite_differences():
    grid = SplineGrid(5, np.zeros(2), np.array([0.5, 0.4]))
    rows = grid.cell_rows(np.array([0.25, 0.75]))
    control = RNG.normal(size=50)

    def cost(at: np.ndarray) -> tuple[float, np.ndarray]:
        gradient = np.zeros(50)
        band = np.zeros((50, grid.bandwidth + 1))
        return add_schwarzian(band, gradient, rows, 0.3, 5, at), gradient

    value, gradient = cost(control)
    numeric = [(cost(control + 1e-6 * e)[0] - cost(control - 1e-6 * e)[0]) / 2e-6 for e in np.eye(50)]
    np.testing.assert_allclose(2 * gradient, numeric, rtol=1e-5, atol=1e-4 * np.abs(numeric).max())
    places = (np.array([[i, j] for i in range(2) for j in range(2)])[:, None] + _nodes()).reshape(-1, 2) * grid.step
    expected = 0.3 * (schwarzian(grid.evaluate(control.reshape(-1, 2), places)) ** 2).sum()
    assert value == pytest.approx(expected, rel=1e-10)


def _nodes() -> np.ndarray:
    return np.array([[i, j] for i in (0.25, 0.75) for j in (0.25, 0.75)])


def test_homography_is_reproduced_by_the_schwarzian_fit_but_not_by_bending():
    grid = SplineGrid.around(POINTS, 12, 0.1)
    truth = derivatives(HOMOGRAPHY, POINTS)
    start = fit_bending(grid, POINTS, truth[:, VALUE], ONES, 0.1)
    control, _, _ = fit_schwarzian(grid, POINTS, truth[:, VALUE], ONES, 0.1, 1e-9, start)
    bent, fitted = grid.evaluate(start, POINTS), grid.evaluate(control, POINTS)
    assert np.abs(bent - truth)[:, VALUE].max() > 0.02
    assert np.abs(fitted - truth)[:, VALUE].max() < 1e-3
    assert np.abs(fitted - truth)[:, 3:].max() < 0.05 * np.abs(truth[:, 3:]).max()
    assert (schwarzian(fitted) ** 2).mean() < 1e-3 * (schwarzian(bent) ** 2).mean()


def test_heavier_penalty_lowers_it_and_raises_the_residual():
    grid = SplineGrid.around(POINTS, 8, 0.1)
    target = POINTS + 0.1 * np.sin(2 * POINTS[:, ::-1])
    start = fit_bending(grid, POINTS, target, ONES, 1e-3)
    penalties, residuals = [], []
    for weight in (1e-4, 1e-2, 1.0):
        control, _, _ = fit_schwarzian(grid, POINTS, target, ONES, weight, 1e-6, start)
        fitted = grid.evaluate(control, POINTS)
        penalties.append((schwarzian(fitted) ** 2).mean())
        residuals.append(np.abs(fitted[:, VALUE] - target).mean())
    assert penalties[0] > penalties[1] > penalties[2]
    assert residuals[0] < residuals[1] < residuals[2]


def test_bending_energy_of_known_functions():
    grid = SplineGrid(9, np.array([-1.0, -0.5]), np.array([0.3, 0.2]))
    points = grid.origin + 6 * grid.step * RNG.uniform(0, 1, (400, 2))  # in all cells: the energy counts all
    u, v = points.T

    def energy(target: np.ndarray) -> float:
        control = fit_bending(grid, points, target, np.ones(400), 1e-12).ravel()
        band = bending_band(grid)
        total = band[:, 0] @ control**2
        for offset in range(1, band.shape[1]):
            total += 2 * (band[: len(control) - offset, offset] * control[:-offset]) @ control[offset:]
        return total

    assert energy(np.column_stack([1 + 2 * u - v, v])) == pytest.approx(0.0, abs=1e-8)
    # |f_uu|^2 = 4 of the first component, 2 |g_uv|^2 = 2 * 9 of the second.
    assert energy(np.column_stack([u**2, 3 * u * v])) == pytest.approx(22.0, rel=1e-5)
