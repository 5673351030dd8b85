"""What one solution by conjugate gradients leaves for the next."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from connrsfm_graph.refine.memory import KEPT, Memory


def matrix(n: int, seed: int, spread: float) -> np.ndarray:
    """Symmetric, with eigenvalues between 1 and exp(spread)."""
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return (vectors * np.exp(spread * rng.random(n))) @ vectors.T


def remembered(A: np.ndarray, directions: np.ndarray) -> Memory:
    memory = Memory()
    memory.keep(list(directions), list(directions @ A))
    return memory


def by(diagonal: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda residual: residual / diagonal


def test_without_memory_the_rough_inverse_is_all() -> None:
    residual, diagonal = np.random.default_rng(0).normal(size=(3, 5)), np.arange(1.0, 6.0)
    memory = Memory()
    memory.keep([], [])
    np.testing.assert_array_equal(memory.precondition(residual, by(diagonal)), residual / diagonal)


@given(st.integers(2, 12), st.integers(0, 5), st.integers(0, 1000))
def test_the_approximate_inverse_is_symmetric_and_positive_definite(n: int, m: int, seed: int) -> None:
    A = matrix(n, seed, 3.0)
    memory = remembered(A, np.random.default_rng(seed).normal(size=(m, n)))
    inverse = memory.precondition(np.eye(n), by(np.diag(A)))
    np.testing.assert_allclose(inverse, inverse.T, rtol=1e-8, atol=1e-8 * np.abs(inverse).max())
    assert np.linalg.eigvalsh(0.5 * (inverse + inverse.T)).min() > 0.0


@given(st.integers(1, 12), st.integers(0, 1000))
def test_conjugate_directions_invert_what_they_span(n: int, seed: int) -> None:
    A = matrix(n, seed, 3.0)
    directions = np.linalg.eigh(A)[1].T[: (n + 1) // 2]
    residual = directions @ A
    inverse = remembered(A, directions).precondition(residual, by(np.ones(n)))
    np.testing.assert_allclose(inverse, directions, atol=1e-8)


def test_the_last_directions_are_kept() -> None:
    n = 2 * KEPT
    A, directions = matrix(n, 0, 5.0), np.eye(n)
    both, last = remembered(A, directions), remembered(A, directions[-KEPT:])
    residual = np.random.default_rng(1).normal(size=(1, n))
    both.keep([], [])
    parts = Memory()
    for part in (directions[: n - 5], directions[n - 5 :]):
        parts.keep(list(part), list(part @ A))
    np.testing.assert_array_equal(
        both.precondition(residual, by(np.diag(A))), last.precondition(residual, by(np.diag(A)))
    )
    np.testing.assert_array_equal(
        parts.precondition(residual, by(np.diag(A))), last.precondition(residual, by(np.diag(A)))
    )
    assert both.precondition(residual, by(np.diag(A))) != pytest.approx(residual / np.diag(A))
