"""Block Cholesky factorisation on the image graph, symbolic once and numeric per point.

All points share the image graph, so the order of elimination (greedy minimum degree) and the fill are found once. A
point that is not seen in an image keeps a unit block there, so that the structure stays shared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class Structure(NamedTuple):
    """Sparsity of the factor L in elimination order. A named tuple, since compiled code takes it as it is."""

    order: np.ndarray
    """(F,) image eliminated at each position."""
    column: np.ndarray
    """(F + 1,) start of each column's off-diagonal blocks."""
    row: np.ndarray
    """(N,) position of each off-diagonal block's row."""
    slot: np.ndarray
    """(E,) off-diagonal block that holds each edge of the image graph."""
    flipped: np.ndarray
    """(E,) bool: the block's row is the edge's image a, so that it holds H_ab and not its transpose."""
    target: np.ndarray
    """Blocks updated by each pair of blocks of a column, in the order the factorisation visits them."""


def analyse(n_frames: int, edges: np.ndarray) -> Structure:
    """Order the images by greedy minimum degree and find the fill."""
    neighbours: list[set[int]] = [set() for _ in range(n_frames)]
    for a, b in edges:
        neighbours[a].add(int(b))
        neighbours[b].add(int(a))
    buckets: dict[int, set[int]] = {}
    for frame, around in enumerate(neighbours):
        buckets.setdefault(len(around), set()).add(frame)
    order, columns = [], []
    for _ in range(n_frames):
        degree = min(size for size, frames in buckets.items() if frames)
        frame = min(buckets[degree])
        buckets[degree].remove(frame)
        around = neighbours[frame]
        order.append(frame)
        columns.append(around)
        for other in around:
            buckets[len(neighbours[other])].remove(other)
            neighbours[other] |= around
            neighbours[other] -= {other, frame}
            buckets.setdefault(len(neighbours[other]), set()).add(other)
    position = np.empty(n_frames, dtype=np.int64)
    position[order] = np.arange(n_frames)
    rows = [sorted(int(position[other]) for other in around) for around in columns]
    start = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64)
    block = {(r, j): int(start[j]) + n for j, column in enumerate(rows) for n, r in enumerate(column)}
    ends = position[np.asarray(edges, dtype=np.int64).reshape(-1, 2)]
    target = [block[r1, r2] for column in rows for n, r1 in enumerate(column) for r2 in column[:n]]
    return Structure(
        order=np.array(order, dtype=np.int64),
        column=start,
        row=np.array([r for column in rows for r in column], dtype=np.int64),
        slot=np.array([block[max(a, b), min(a, b)] for a, b in ends], dtype=np.int64),
        flipped=ends[:, 0] > ends[:, 1],
        target=np.array(target, dtype=np.int64),
    )


@njit(cache=True)
def factor_and_solve(structure, diagonal, lower, x):
    """Solve H x = rhs in place for symmetric positive definite H.

    Args:
        structure: from `analyse`.
        diagonal: (F, n, n) diagonal blocks of H by image; overwritten.
        lower: (N, n, n) off-diagonal blocks in factor order (fill-in zero); overwritten.
        x: (F, n) right-hand side by image; overwritten by the solution.

    Returns:
        False where H is not positive definite (outputs are then meaningless).
    """
    order, column, row, target = structure.order, structure.column, structure.row, structure.target
    F, n = x.shape
    t = 0
    for j in range(F):
        D = diagonal[order[j]]
        for c in range(n):
            for r in range(c, n):
                s = D[r, c]
                for k in range(c):
                    s -= D[r, k] * D[c, k]
                if r == c:
                    if not s > 0.0:
                        return False
                    D[c, c] = np.sqrt(s)
                else:
                    D[r, c] = s / D[c, c]
        v = x[order[j]]
        for c in range(n):
            s = v[c]
            for k in range(c):
                s -= D[c, k] * v[k]
            v[c] = s / D[c, c]
        for m in range(column[j], column[j + 1]):
            L = lower[m]
            for r in range(n):
                for c in range(n):
                    s = L[r, c]
                    for k in range(c):
                        s -= L[r, k] * D[c, k]
                    L[r, c] = s / D[c, c]
            i = order[row[m]]
            H, w = diagonal[i], x[i]
            for r in range(n):
                for c in range(r + 1):
                    s = 0.0
                    for k in range(n):
                        s += L[r, k] * L[c, k]
                    H[r, c] -= s
                s = 0.0
                for k in range(n):
                    s += L[r, k] * v[k]
                w[r] -= s
            for m2 in range(column[j], m):
                L2 = lower[m2]
                T = lower[target[t]]
                t += 1
                for r in range(n):
                    for c in range(n):
                        s = 0.0
                        for k in range(n):
                            s += L[r, k] * L2[c, k]
                        T[r, c] -= s
    for j in range(F - 1, -1, -1):
        v = x[order[j]]
        for m in range(column[j], column[j + 1]):
            w = x[order[row[m]]]
            L = lower[m]
            for r in range(n):
                for c in range(n):
                    v[c] -= L[r, c] * w[r]
        D = diagonal[order[j]]
        for c in range(n - 1, -1, -1):
            s = v[c]
            for k in range(c + 1, n):
                s -= D[k, c] * v[k]
            v[c] = s / D[c, c]
    return True
