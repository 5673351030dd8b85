"""Keys survive the round trip and speak in words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import keys


@given(st.sampled_from("dcbsqfehtgmZ"), st.integers(0, 2**32 - 1), st.integers(0, 2**24 - 1))
def test_round_trip(letter, first, second):
    packed = keys.key(letter, first, second)
    assert packed < 2**63
    assert keys.decode(packed) == (letter, first, second)


def test_words():
    assert keys.describe(keys.key("b", 12, 3)) == "log depth of point 12, view 3"
    assert keys.describe(keys.key("s", 12, 3)) == "log conformal scale of point 12, edge 3"
    assert keys.describe(keys.key("t", 0, 3)) == "camera pose of view 3"
    assert keys.describe(keys.key("z", 1, 2)) == "z(1, 2)"


@pytest.mark.parametrize("letter", "xlp")
def test_letters_of_slam_code_are_free(letter):
    assert letter not in keys._NAMES


@pytest.mark.parametrize(("letter", "first", "second"), [("bb", 0, 0), ("é", 0, 0), ("b", -1, 0), ("b", 0, 2**24)])
def test_refuses_what_does_not_fit(letter, first, second):
    with pytest.raises(ValueError, match="key"):
        keys.key(letter, first, second)
