"""The spline basis: a partition of unity whose derivatives are those of its values."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.warps.basis import UU, UV, VALUE, VV, SplineGrid, U, V

RNG = np.random.default_rng(0)
GRID = SplineGrid(7, np.array([-1.0, 2.0]), np.array([0.5, 0.8]))
INSIDE = GRID.origin + GRID.step * 4 * RNG.uniform(0.05, 0.95, (20, 2))


def test_rows_are_a_partition_of_unity():
    _, rows = GRID.rows(INSIDE)
    assert (rows[:, VALUE] >= 0).all()
    np.testing.assert_allclose(rows.sum(axis=-1), [[1, 0, 0, 0, 0, 0]] * 20, atol=1e-12)


@pytest.mark.parametrize(
    ("derivative", "of", "axis"), [(U, VALUE, 0), (V, VALUE, 1), (UU, U, 0), (UV, U, 1), (UV, V, 0), (VV, V, 1)]
)
def test_derivatives_match_finite_differences(derivative, of, axis):
    control = RNG.normal(size=(49, 2))
    step = 1e-6 * np.eye(2)[axis]
    ahead, behind = (GRID.evaluate(control, INSIDE + sign * step)[:, of] for sign in (1, -1))
    np.testing.assert_allclose(GRID.evaluate(control, INSIDE)[:, derivative], (ahead - behind) / 2e-6, atol=1e-6)


def test_second_derivatives_are_continuous_across_cells():
    control = RNG.normal(size=(49, 2))
    border = GRID.origin + GRID.step * np.array([2.0, 1.4])
    near = GRID.evaluate(control, border + np.array([[-1e-9, 0.0], [1e-9, 0.0]]))
    np.testing.assert_allclose(near[0], near[1], atol=1e-6)


def test_grid_covers_the_points_even_when_they_are_thin():
    points = np.column_stack([np.linspace(0, 1, 9), np.zeros(9)])
    grid = SplineGrid.around(points, 8, 0.1)
    assert (grid.origin < points.min(axis=0)).all()
    assert (grid.origin + 5 * grid.step > points.max(axis=0)).all()
    assert grid.step.min() > 1e-3


def test_rows_of_a_cell_are_those_of_its_places():
    nodes = np.array([0.2, 0.7])
    place = GRID.origin + GRID.step * (np.array([1, 2]) + np.array([0.2, 0.7]))
    np.testing.assert_allclose(GRID.rows(place[None])[1][0], GRID.cell_rows(nodes)[1], atol=1e-12)
