from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.polynomial import polyval2d

from connrsfm_graph.baselines.polynomial import affine, global_minimum, product


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_product_takes_the_product_of_the_values(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, q = rng.standard_normal((4, 3, 3)), rng.standard_normal((2, 2))
    x, y = rng.standard_normal(2)
    values = np.array([polyval2d(x, y, each) for each in p]) * polyval2d(x, y, q)
    np.testing.assert_allclose([polyval2d(x, y, each) for each in product(p, q)], values, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_no_point_of_a_grid_is_below_the_global_minimum(seed: int) -> None:
    """Sums of squares of random cubics, as in infinitesimal planarity; most have several local minima."""
    rng = np.random.default_rng(seed)
    cubics = np.where(np.add.outer(range(4), range(4)) <= 3, rng.standard_normal((5, 4, 4)), 0.0)
    cost = product(cubics, cubics).sum(axis=0)
    best = polyval2d(*global_minimum(cost), cost)
    grid = np.stack(np.meshgrid(*[np.linspace(-4.0, 4.0, 161)] * 2), axis=-1)
    assert best <= polyval2d(grid[..., 0], grid[..., 1], cost).min() * (1 + 1e-9)


def test_a_common_zero_is_found_to_rounding() -> None:
    x, y = affine(np.array(-0.3), 1.0, 0.0), affine(np.array(0.7), 0.0, 1.0)
    cubics = [product(x, product(x, y)), product(y, product(y, y)), product(x, product(x, x))]
    cost = sum(product(each, each) for each in cubics)
    # The zero is flat to the sixth order, so the value is what matters.
    assert polyval2d(*global_minimum(cost), cost) < 1e-12
