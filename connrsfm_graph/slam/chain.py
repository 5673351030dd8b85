"""Chains of map points: block-banded systems of many points at once, and their share in the cameras' equations.

A point's sightings n, in order of views, have 3 x 3 blocks A_n and couple to the next one or two sightings by
multiples of the identity. Block elimination from the first sighting to the last gives

    x_n = D_n^-1 y_n + W1_n x_n+1 + W2_n x_n+2,

and the same recursion, run backwards from the diagonal, gives the blocks of A^-1 that E^T A^-1 E asks for.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def _add(out, left, right, transposed, sign):
    """out += sign left right, or sign left^T right, for 3 x 3 times 3 x C."""
    for i in range(3):
        for j in range(3):
            factor = sign * (left[j, i] if transposed else left[i, j])
            for c in range(out.shape[1]):
                out[i, c] += factor * right[j, c]


@njit(cache=True)
def _invert(A, out):
    """Inverse of a symmetric 3 x 3 matrix; whether it is positive definite."""
    c0 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c1 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c2 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    det = A[0, 0] * c0 + A[0, 1] * c1 + A[0, 2] * c2
    if not (A[0, 0] > 0.0 and minor > 0.0 and det > 0.0):
        return False
    out[0, 0], out[1, 1], out[2, 2] = c0 / det, (A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]) / det, minor / det
    out[0, 1] = out[1, 0] = c1 / det
    out[0, 2] = out[2, 0] = c2 / det
    out[1, 2] = out[2, 1] = (A[0, 2] * A[0, 1] - A[0, 0] * A[1, 2]) / det
    return True


@njit(cache=True)
def factorise(starts, blocks, off, inverse, W):
    """Block elimination of all chains.

    Args:
        starts: (points + 1,) first sighting of every chain.
        blocks: (N, 3, 3) diagonal blocks; overwritten.
        off: (2, N) multiples of the identity that couple sighting n to n + 1 and n + 2.
        inverse: output (N, 3, 3), D_n^-1.
        W: output (2, N, 3, 3), W1 and W2; zero where there is nothing to couple to.

    Returns:
        Whether all chains are positive definite.
    """
    near, far = np.empty((3, 3)), np.empty((3, 3))
    W[:] = 0.0
    for p in range(len(starts) - 1):
        for n in range(starts[p], starts[p + 1]):
            if not _invert(blocks[n], inverse[n]):
                return False
            near[:], far[:] = 0.0, 0.0
            for i in range(3):
                near[i, i], far[i, i] = off[0, n], off[1, n]
            if n > starts[p]:
                for i in range(3):
                    for j in range(3):
                        near[i, j] += W[0, n - 1, j, i] * off[1, n - 1]
            if n + 1 < starts[p + 1]:
                _add(W[0, n], inverse[n], near, False, -1.0)
                _add(blocks[n + 1], near, W[0, n], True, 1.0)
            if n + 2 < starts[p + 1]:
                _add(W[1, n], inverse[n], far, False, -1.0)
                _add(blocks[n + 2], far, W[1, n], True, 1.0)
    return True


@njit(cache=True)
def solve(starts, inverse, W, right):
    """A^-1 right for all chains, (N, 3)."""
    y = right.copy().reshape(-1, 3, 1)
    x = np.zeros_like(y)
    for p in range(len(starts) - 1):
        first, last = starts[p], starts[p + 1]
        for n in range(first, last):
            for d in range(1, 3):
                if n + d < last:
                    _add(y[n + d], W[d - 1, n], y[n], True, 1.0)
        for n in range(last - 1, first - 1, -1):
            _add(x[n], inverse[n], y[n], False, 1.0)
            for d in range(1, 3):
                if n + d < last:
                    _add(x[n], W[d - 1, n], x[n + d], False, 1.0)
    return x.reshape(-1, 3)


@njit(cache=True)
def subtract_coupling(starts, inverse, W, coupling, columns, hessian):
    """Subtract half of E^T A^-1 E of all chains, so that `hessian` plus its transpose holds the whole.

    Args:
        starts, inverse, W: as in `factorise`.
        coupling: (N, 3, C) rows of E.
        columns: (N, C) where they stand in the hessian, -1 for nowhere.
        hessian: changed in place.
    """
    C = columns.shape[1]
    X = np.zeros((3, 3, 3, 3))  # X[i, d]: block (j + i, j + i + d) of A^-1, for the sighting j at hand
    Z = np.zeros((3, 3, C))  # Z[i]: row k + i of A^-1 E_j, for the sighting k at hand
    for p in range(len(starts) - 1):
        first, last = starts[p], starts[p + 1]
        for j in range(last - 1, first - 1, -1):
            X[2], X[1] = X[1], X[0]
            _inverse_blocks(last - j, inverse[j], W[:, j], X)
            for k in range(j, first - 1, -1):
                Z[2], Z[1] = Z[1], Z[0]
                Z[0] = 0.0
                if k == j:
                    Z[1] = 0.0
                    if j + 1 < last:
                        _add(Z[1], X[0, 1], coupling[j], True, 1.0)
                    _add(Z[0], X[0, 0], coupling[j], False, 1.0)
                else:
                    _add(Z[0], W[0, k], Z[1], False, 1.0)
                    _add(Z[0], W[1, k], Z[2], False, 1.0)
                share = 0.5 if k == j else 1.0
                for a in range(C):
                    row = columns[k, a]
                    if row < 0:
                        continue
                    e0, e1, e2 = share * coupling[k, 0, a], share * coupling[k, 1, a], share * coupling[k, 2, a]
                    for c in range(C):
                        column = columns[j, c]
                        if column >= 0:
                            hessian[row, column] -= e0 * Z[0, 0, c] + e1 * Z[0, 1, c] + e2 * Z[0, 2, c]


@njit(cache=True)
def _inverse_blocks(length, inverse, W, X):
    """Blocks (j, j), (j, j + 1) and (j, j + 2) of A^-1 into X[0], from those of j + 1 and j + 2 (Takahashi)."""
    X[0] = 0.0
    if length > 1:
        _add(X[0, 1], W[0], X[1, 0], False, 1.0)
        if length > 2:
            _add(X[0, 1], W[1], X[1, 1].T, False, 1.0)
            _add(X[0, 2], W[0], X[1, 1], False, 1.0)
            _add(X[0, 2], W[1], X[2, 0], False, 1.0)
    X[0, 0] = inverse
    for d in range(1, min(length, 3)):
        _add(X[0, 0], W[d - 1], X[0, d].T, False, 1.0)
