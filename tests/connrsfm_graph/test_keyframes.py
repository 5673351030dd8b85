"""Which images are reconstructed jointly, and which one each other image follows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from connrsfm_graph.errors import InputError
from connrsfm_graph.keyframes import KeyframeConfig, choose_keyframes, nearest_keyframe


def test_a_short_sequence_is_reconstructed_jointly():
    assert choose_keyframes(np.ones((32, 20), dtype=bool), KeyframeConfig(), 6).tolist() == list(range(32))
    assert len(choose_keyframes(np.ones((90, 20), dtype=bool), KeyframeConfig(most=None), 6)) == 90


def test_keyframes_are_spread_evenly():
    keys = choose_keyframes(np.ones((101, 20), dtype=bool), KeyframeConfig(most=11), 6)
    assert keys.tolist() == list(range(0, 101, 10))


@given(st.integers(0, 1000), st.floats(0.1, 0.9))
def test_every_point_and_image_is_reached(seed, fraction):
    rng = np.random.default_rng(seed)
    visible = rng.uniform(size=(60, 40)) < fraction
    keys = choose_keyframes(visible, KeyframeConfig(most=8), 6)
    assert (visible[keys].sum(axis=0) >= np.minimum(visible.sum(axis=0), 2)).all()
    if len(keys) < 60:
        assert ((visible.astype(int) @ visible[keys].T).max(axis=1) >= 6).all()


def test_tracks_that_come_and_go_need_keyframes_that_overlap():
    start = np.arange(200)
    frames = np.arange(200)[:, None]
    visible = (frames >= start - 15) & (frames < start + 15)
    keys = choose_keyframes(visible, KeyframeConfig(most=8), 6)
    assert np.diff(keys).max() <= 24
    assert len(keys) < 200


def test_an_image_follows_the_keyframe_that_looks_like_it():
    rng = np.random.default_rng(0)
    key_image = rng.normal(size=(5, 30, 2))
    of = np.array([3, 0, 4])
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    image = 2.0 * key_image[of] @ turn + 1.0 + 0.05 * rng.normal(size=(3, 30, 2))
    visible, key_visible = rng.uniform(size=(3, 30)) < 0.7, rng.uniform(size=(5, 30)) < 0.7
    hidden = np.where(visible[..., None], image, np.nan)
    assert nearest_keyframe(hidden, visible, key_image, key_visible, 6).tolist() == of.tolist()


def test_too_few_keyframes_are_refused():
    with pytest.raises(InputError, match=r"keyframes\.most is 3, expected at least 5"):
        KeyframeConfig(most=3)
