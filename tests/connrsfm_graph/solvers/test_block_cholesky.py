"""Block Cholesky against a dense solve, on graphs of any shape."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from connrsfm_graph.solvers.block_cholesky import analyse, factor_and_solve


@settings(deadline=None, max_examples=50)
@given(n_frames=st.integers(1, 9), size=st.integers(1, 6), density=st.floats(0, 1), seed=st.integers(0, 2**31))
def test_equals_dense_solve(n_frames, size, density, seed):
    rng = np.random.default_rng(seed)
    pairs = [(a, b) for a in range(n_frames) for b in range(a + 1, n_frames) if rng.random() < density]
    edges = np.array([pair if rng.random() < 0.5 else pair[::-1] for pair in pairs], dtype=int).reshape(-1, 2)
    structure = analyse(n_frames, edges)
    diagonal = np.tile(0.1 * np.eye(size), (n_frames, 1, 1))
    lower = np.zeros((len(structure.row), size, size))
    dense = 0.1 * np.eye(n_frames * size)
    for e, (a, b) in enumerate(edges):
        jacobian = rng.normal(size=(2 * size, 2 * size))
        normal = jacobian.T @ jacobian
        diagonal[a] += normal[:size, :size]
        diagonal[b] += normal[size:, size:]
        lower[structure.slot[e]] += normal[:size, size:] if structure.flipped[e] else normal[size:, :size]
        index = np.r_[a * size : (a + 1) * size, b * size : (b + 1) * size]
        dense[np.ix_(index, index)] += normal
    right = rng.normal(size=(n_frames, size))
    x = right.copy()
    assert factor_and_solve(structure, diagonal, lower, x)
    assert x.ravel() == pytest.approx(np.linalg.solve(dense, right.ravel()), rel=1e-7, abs=1e-9)


def test_trees_have_no_fill():
    edges = np.array([(3, j) for j in range(8) if j != 3])
    assert len(analyse(8, edges).row) == len(edges)


def test_indefinite_systems_are_noticed():
    structure = analyse(1, np.empty((0, 2), dtype=int))
    assert not factor_and_solve(structure, -np.eye(2)[None], np.zeros((0, 2, 2)), np.ones((1, 2)))
