"""Sums of products in vector lanes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from numba.core.errors import TypingError

from connrsfm_graph.refine.sums import sums_of_products


@njit
def two_by_three(a, b, size):
    return sums_of_products((a[0], a[1]), (b[0], b[1], b[2]), size)


@njit
def one_by_one(a, b):
    return sums_of_products((a,), (b,), len(a))


@given(st.integers(0, 40), st.integers(0, 3), st.integers(0, 1000))
def test_they_are_the_products_of_the_first_entries(size, unused, seed):
    rng = np.random.default_rng(seed)
    # Whole numbers, whose sums are exact in any order.
    a, b = (rng.integers(-1000, 1000, (rows, size + unused)).astype(float) for rows in (2, 3))
    expected = a[:, :size] @ b[:, :size].T
    a[:, size:] = b[:, size:] = np.nan
    np.testing.assert_array_equal(np.reshape(two_by_three(a, b, size), (2, 3)), expected)


@pytest.mark.parametrize("place", [0, 1, 2, 3])
def test_bits_do_not_depend_on_the_place_in_memory(place):
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 1001))
    room = np.empty(1010)
    room[place : place + 1001] = a
    assert one_by_one(room[place : place + 1001], b) == one_by_one(a, b)
    np.testing.assert_allclose(one_by_one(a, b)[0], a @ b, rtol=1e-12)


def test_gaps_between_entries_are_refused():
    a = np.ones(10)
    with pytest.raises(TypingError, match="contiguous arrays of floats"):
        one_by_one(a[::2], a[::2])
