"""The mesh of the surface: which points are neighbours, the same in every view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import Delaunay, QhullError, cKDTree

_COINCIDENT = 0.01
"""Points nearer than this part of the median distance to the nearest neighbour are one point tracked twice."""
_LONGEST = 3.0
"""A triangle with a side longer than this many times the spacing at its ends bridges a gap."""
_NEAREST = 6
"""Neighbours of a point outside every triangle."""


@dataclass(frozen=True)
class Mesh:
    """Edges and hinges over P points. The first edges are the triangulation's own, then come those of the two-ring."""

    position: np.ndarray
    """(P, 2) points in the plane of the triangulation."""
    triangles: np.ndarray
    """(T, 3) int, counter-clockwise in no particular view."""
    edges: np.ndarray
    """(E, 2) int, i < k."""
    n_near: int
    """The first n_near edges join neighbours of the triangulation."""
    hinges: np.ndarray
    """(H, 4) int: shared edge x0 x1, opposite corners x2, x3."""
    hinge_edges: np.ndarray
    """(H, 5) int, the edges 01, 02, 12, 03, 13 of each hinge."""

    @property
    def direction(self) -> np.ndarray:
        """(E, 2) cosine and sine of twice every edge's angle in the plane."""
        x, y = (self.position[self.edges[:, 1]] - self.position[self.edges[:, 0]]).T
        square = np.maximum(x * x + y * y, np.finfo(float).tiny)
        return np.stack([(x * x - y * y) / square, 2.0 * x * y / square], axis=1)

    @property
    def n_points(self) -> int:
        return len(self.position)

    def usual(self, value: np.ndarray) -> np.ndarray:
        """What is usual of the values (E,) of edges about each edge, (E,): the median of near ones at either end."""
        near = slice(self.n_near)
        return np.asarray(_medians(self.n_points, self.edges[near], value[near])[self.edges].mean(axis=1))

    def order(self) -> np.ndarray:
        """(P,) position of every point in the sweep across the surface whose matrices have the smallest envelope."""
        terms = self.edges if len(self.hinges) == 0 else np.concatenate([self.edges, self.hinges[:, 2:]])
        best, fewest = np.arange(self.n_points), np.inf
        for angle in np.linspace(0.0, np.pi, 8, endpoint=False):
            order = np.empty(self.n_points, dtype=np.int64)
            along = self.position @ np.array([np.cos(angle), np.sin(angle)])
            order[np.argsort(along, kind="stable")] = np.arange(self.n_points)
            first = np.arange(self.n_points)
            low, high = np.sort(order[terms], axis=1).T
            np.minimum.at(first, high, low)
            entries = (np.arange(self.n_points) - first).sum()
            if entries < fewest:
                best, fewest = order, entries
        return best


def triangulate(position: np.ndarray) -> np.ndarray:
    """Delaunay triangles (T, 3) of plane points (P, 2); none where the points are fewer than three or on a line."""
    if len(position) < 3:
        return np.empty((0, 3), dtype=np.int64)
    try:
        return Delaunay(position).simplices.astype(np.int64)
    except QhullError:
        return np.empty((0, 3), dtype=np.int64)


def surface_mesh(position: np.ndarray, log_length: Callable[[np.ndarray], np.ndarray], rings: int = 2) -> Mesh:
    """Mesh of a surface known by the plane position of its points and by the lengths of its edges.

    Triangles that bridge a gap of the surface are left out. A point that coincides with another one has that point's
    neighbours; a point outside every triangle is joined to its nearest ones.

    Args:
        position: (P, 2) points in the plane, for instance in one image.
        log_length: log lengths (N,) of point pairs (N, 2).
        rings: edges join points up to this distance in the triangulation, 1 or 2.
    """
    P = len(position)
    twin = _twins(position)
    own = np.flatnonzero(twin == np.arange(P))
    triangles = own[triangulate(position[own])]
    sides = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    length = np.exp(log_length(sides)).reshape(-1, 3)
    spacing = _medians(P, sides, length.ravel())
    longest = length.argmax(axis=1)
    rows = np.arange(len(triangles))
    ends = spacing[triangles[rows, longest]] + spacing[triangles[rows, (longest + 1) % 3]]
    triangles = triangles[length[rows, longest] <= _LONGEST * 0.5 * ends]
    joined = np.zeros(P, dtype=bool)
    joined[triangles] = True
    near = [triangles[:, [n, n - 1]] for n in range(3)]
    for point in own[~joined[own]]:
        others = own[own != point]
        nearest = others[np.argsort(((position[others] - position[point]) ** 2).sum(axis=1), kind="stable")[:_NEAREST]]
        near.append(np.stack([np.full(len(nearest), point), nearest], axis=1))
    for point in np.flatnonzero(twin != np.arange(P)):
        around = np.concatenate(near)
        around = around[(around == twin[point]).any(axis=1)]
        near.append(np.where(around == twin[point], point, around))
    return _assemble(position, triangles, np.concatenate(near), twin, rings)


def _twins(position: np.ndarray) -> np.ndarray:
    """(P,) the first point at each point's place, usually itself."""
    tree = cKDTree(position)
    nearest = tree.query(position, k=min(2, len(position)))[0].reshape(len(position), -1)[:, -1]
    twin = np.arange(len(position))
    for i, k in sorted(tree.query_pairs(_COINCIDENT * float(np.median(nearest)))):
        twin[k] = min(twin[k], twin[i])
    return twin


def _medians(n_points: int, pairs: np.ndarray, value: np.ndarray) -> np.ndarray:
    """(P,) median of the values (N,) of the pairs (N, 2) that a point belongs to; zero of none."""
    order = np.argsort(pairs.ravel(), kind="stable")
    ends = np.searchsorted(pairs.ravel()[order], np.arange(1, n_points))
    groups = np.split(np.repeat(value, 2)[order], ends)
    return np.array([np.median(group) if len(group) else 0.0 for group in groups])


def _assemble(position: np.ndarray, triangles: np.ndarray, near: np.ndarray, twin: np.ndarray, rings: int) -> Mesh:
    P = len(position)
    near = np.unique(np.sort(near, axis=1), axis=0)
    edges = near
    if rings == 2:
        ends = np.concatenate([near, near[:, ::-1]])
        graph = csr_matrix((np.ones(len(ends)), tuple(ends.T)), shape=(P, P))
        reach = np.argwhere(np.triu((graph @ graph).toarray() > 0, 1) & ~graph.toarray().astype(bool))
        edges = np.concatenate([near, reach[twin[reach[:, 0]] != twin[reach[:, 1]]]])
    hinges = _hinges(triangles)
    number = {pair: n for n, pair in enumerate(map(tuple, near.tolist()))}
    corners = hinges[:, [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3]]]
    hinge_edges = np.array([[number[min(p), max(p)] for p in hinge] for hinge in corners.tolist()], dtype=np.int64)
    return Mesh(position, triangles, edges.astype(np.int64), len(near), hinges, hinge_edges.reshape(-1, 5))


def _hinges(triangles: np.ndarray) -> np.ndarray:
    """Pairs of triangles that share a side: (H, 4) with the shared side first."""
    opposite: dict[tuple[int, int], list[int]] = {}
    for triangle in triangles.tolist():
        for n in range(3):
            a, b, corner = triangle[n - 2], triangle[n - 1], triangle[n]
            opposite.setdefault((min(a, b), max(a, b)), []).append(corner)
    found = [(a, b, *corners) for (a, b), corners in sorted(opposite.items()) if len(corners) == 2]
    return np.array(found, dtype=np.int64).reshape(-1, 4)
