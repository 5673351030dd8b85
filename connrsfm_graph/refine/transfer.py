"""Where a point must be by its neighbourhood: the local shape is taken over from views that saw it.

A small patch moves almost rigidly, whatever the surface does at large. So the neighbours' positions in two views tell
the rotation and translation of the patch between them, which take the point along.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.threads import over_views

_UNSEEN = 0.1
"""Weight of a neighbour's position where it was not seen itself."""
_SOURCES = 5
"""A point is taken over from at most so many views, those with the best seen neighbourhood."""


def transfer(points: np.ndarray, seen: np.ndarray, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Positions of all points by the motion of their neighbours, the point itself left out.

    Args:
        points: (F, P, 3) present positions in the camera frames.
        seen: (F, P) bool, the position rests on an observation.
        mesh: who is whose neighbour.

    Returns:
        (F, P, 3) positions, the median over views in which the point was seen, and (F, P) the number of these views;
        where it is 0 the positions are the present ones.
    """
    ends = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    ends = ends[np.lexsort(ends.T[::-1])]
    start = np.searchsorted(ends[:, 0], np.arange(mesh.n_points + 1))
    moved, sources = points.copy(), np.zeros(seen.shape, dtype=np.int64)
    weight = np.where(seen, 1.0, _UNSEEN)
    over_views(_transfer, len(points), points, seen, weight, start, np.ascontiguousarray(ends[:, 1]), moved, sources)
    return moved, sources


@njit(cache=True, nogil=True)
def _transfer(begin, end, points, seen, weight, start, neighbour, moved, sources):
    F, P, _ = points.shape
    support, found = np.empty(F), np.empty((_SOURCES, 3))
    for f in range(begin, end):
        for i in range(P):
            around = neighbour[start[i] : start[i + 1]]
            for g in range(F):
                support[g] = 0.0
                if g != f and seen[g, i]:
                    for k in around:
                        support[g] += weight[f, k] * weight[g, k]
            n = 0
            for g in np.argsort(-support)[:_SOURCES]:
                if support[g] > 0.0 and len(around) >= 3:
                    _carry(points[g], points[f], weight[g], weight[f], i, around, found[n])
                    n += 1
            if n > 0:
                for c in range(3):
                    moved[f, i, c] = np.median(found[:n, c])
            sources[f, i] = n


@njit(cache=True)
def _carry(source, target, source_weight, target_weight, i, around, out):
    """Where point i of `source` goes by the rigid motion that takes its neighbours to `target` (Kabsch)."""
    total = 0.0
    a, b = np.zeros(3), np.zeros(3)
    for k in around:
        w = source_weight[k] * target_weight[k]
        total += w
        a += w * source[k]
        b += w * target[k]
    a /= total
    b /= total
    H = np.zeros((3, 3))
    for k in around:
        w = source_weight[k] * target_weight[k]
        for r in range(3):
            for c in range(3):
                H[r, c] += w * (target[k, r] - b[r]) * (source[k, c] - a[c])
    U, _, V = np.linalg.svd(H)
    if np.linalg.det(U) * np.linalg.det(V) < 0.0:
        U[:, 2] = -U[:, 2]
    out[:] = b + U @ (V @ (source[i] - a))
