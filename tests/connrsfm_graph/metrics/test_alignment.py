from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics import align_similarity


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100.0))
def test_a_similarity_is_recovered(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source, t = rng.standard_normal((12, 3)), rng.standard_normal(3)
    R = Rotation.random(rng=rng).as_matrix()
    got = align_similarity(source, scale * source @ R.T + t)
    assert got[0] == pytest.approx(scale, rel=1e-10)
    np.testing.assert_allclose(got[1], R, atol=1e-10)
    np.testing.assert_allclose(got[2], t, atol=1e-10 * scale + 1e-10)


def test_a_mirrored_source_is_not_aligned_away() -> None:
    source = np.random.default_rng(0).standard_normal((20, 3))
    target = source * [1.0, 1.0, -1.0]
    scale, R, t = align_similarity(source, target)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.linalg.norm(scale * source @ R.T + t - target) > 0.5


def test_the_aligned_cost_is_a_minimum_under_weights() -> None:
    rng = np.random.default_rng(1)
    source, target, weight = rng.standard_normal((9, 3)), rng.standard_normal((9, 3)), rng.random(9)
    scale, R, t = align_similarity(source, target, weight)

    def cost(scale: float, R: np.ndarray, t: np.ndarray) -> float:
        return float(weight @ ((scale * source @ R.T + t - target) ** 2).sum(axis=1))

    least = cost(scale, R, t)
    for step in 1e-3 * rng.standard_normal((50, 7)):
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        assert cost(scale + step[3], turned, t + step[4:]) >= least


def test_a_point_of_no_weight_has_no_influence() -> None:
    rng = np.random.default_rng(2)
    source = rng.standard_normal((8, 3))
    target = 2.0 * source + 1.0
    target[3] += 100.0
    weight = np.ones(8)
    weight[3] = 0.0
    assert align_similarity(source, target, weight)[0] == pytest.approx(2.0)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(InputError, match="at least 3 points, got 2"):
        align_similarity(np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(InputError, match="equal shape"):
        align_similarity(np.zeros((4, 3)), np.zeros((5, 3)))
