"""Inextensible surfaces as one second-order cone programme for all images, shared by `mdh` and `mlh`.

Unknowns are the legs x_fi, distances from the camera along unit sight rays r_fi, and one length d_e per edge e = (i, k)
of a nearest-neighbour graph, shared by all images:

    maximise    c . x
    subject to  |x_fi r_fi - x_fk r_fk| <= d_e  wherever both points are seen,   sum_e d_e = 1,   x >= 0.

Two rays span a plane, so the distance has two coordinates, (x_i - cos x_k, sin x_k), with the angle between the rays.
The sum of the lengths fixes the scale of the whole sequence. Solved by Clarabel, an interior-point method.
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
from scipy.sparse import coo_array, csc_array

from connrsfm_graph.errors import ComputationError


@dataclass(frozen=True)
class InextensibleProgramme:
    """Rays, edges and where they constrain each other."""

    rays: np.ndarray
    """(F, P, 3) unit sight rays, 0 where not visible."""
    bound: np.ndarray
    """(F, P) bool: visible, and so is a neighbour; other legs would be unbounded and are left out."""
    edges: np.ndarray
    """(E, 2) points of each edge."""
    frame: np.ndarray
    """(C,) image of each constraint."""
    edge: np.ndarray
    """(C,) edge of each constraint."""

    @staticmethod
    def of(image: np.ndarray, visible: np.ndarray, neighbours: int) -> InextensibleProgramme:
        """The programme of tracks: `image` (F, P, 2) normalised coordinates, `visible` (F, P) bool."""
        rays = np.concatenate([np.nan_to_num(image), np.ones((*visible.shape, 1))], axis=-1)
        rays *= visible[..., None] / np.linalg.norm(rays, axis=-1, keepdims=True)
        edges = nearest_neighbour_edges(image, visible, neighbours)
        both = visible[:, edges[:, 0]] & visible[:, edges[:, 1]]
        frame, edge = np.nonzero(both)
        bound = np.zeros_like(visible)
        for end in (0, 1):
            bound[frame, edges[edge, end]] = True
        return InextensibleProgramme(rays, bound, edges, frame, edge)

    def distances(self, legs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(C, 2) coordinates of every constraint's distance for legs (F, P), and its (C, 4) derivatives.

        Columns: the first coordinate by x_i and by x_k, the second one likewise.
        """
        i, k = self.edges[self.edge].T
        cos = (self.rays[self.frame, i] * self.rays[self.frame, k]).sum(axis=-1)
        one, zero = np.ones_like(cos), np.zeros_like(cos)
        rows = np.stack([one, -cos, zero, np.sqrt(np.maximum(1.0 - cos**2, 0.0))], axis=-1)
        ends = np.stack([legs[self.frame, i], legs[self.frame, k]], axis=-1)
        return np.einsum("cdj,cj->cd", rows.reshape(-1, 2, 2), ends), rows

    def maximise(self, objective: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Legs (F, P), 0 where not bound, and edge lengths (E,) that maximise objective (F, P) . legs.

        Raises:
            ComputationError: the solver found no optimum.
        """
        n_legs, E, C = int(self.bound.sum()), len(self.edges), len(self.edge)
        column = np.full(self.bound.shape, -1)
        column[self.bound] = np.arange(n_legs)
        A = self._constraints(column, n_legs)
        b = np.zeros(A.shape[0])
        b[0] = 1.0
        # Conic form: A z + s = b with s in the zero cone, the non-negative cone and one cone of size 3 per constraint.
        cones = [clarabel.ZeroConeT(1), clarabel.NonnegativeConeT(n_legs), *(clarabel.SecondOrderConeT(3),) * C]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        cost = np.concatenate([-objective[self.bound], np.zeros(E)])
        nothing = csc_array((len(cost), len(cost)))
        solution = clarabel.DefaultSolver(nothing, cost, A, b, cones, settings).solve()
        if str(solution.status) not in ("Solved", "AlmostSolved"):
            raise ComputationError(f"the inextensible programme has no optimum (Clarabel says {solution.status})")
        z = np.array(solution.x)
        legs = np.zeros(self.bound.shape)
        legs[self.bound] = z[:n_legs]
        return legs, z[n_legs:]

    def _constraints(self, column: np.ndarray, n_legs: int) -> csc_array:
        E, C = len(self.edges), len(self.edge)
        i, k = (column[self.frame, self.edges[self.edge, end]] for end in (0, 1))
        _, rows = self.distances(column)
        cone = 1 + n_legs + 3 * np.arange(C)
        entries = [
            (np.zeros(E, dtype=int), n_legs + np.arange(E), np.ones(E)),
            (1 + np.arange(n_legs), np.arange(n_legs), -np.ones(n_legs)),
            (cone, n_legs + self.edge, -np.ones(C)),
            *((cone + 1 + row, end, -rows[:, 2 * row + j]) for row in (0, 1) for j, end in enumerate((i, k))),
        ]
        row, col, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        return csc_array(coo_array((value, (row, col)), shape=(1 + n_legs + 3 * C, n_legs + E)))


def nearest_neighbour_edges(image: np.ndarray, visible: np.ndarray, neighbours: int) -> np.ndarray:
    """(E, 2) edges i < k from every point to its nearest ones.

    The distance of two points is the largest image distance over the images that see both, so that neighbours are
    close in all images (across a fold they are not); points never seen together have none.
    """
    P = visible.shape[1]
    distance = np.full((P, P), -np.inf)
    for points, seen in zip(image, visible, strict=True):
        apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
        distance = np.maximum(distance, np.where(seen[:, None] & seen[None], apart, -np.inf))
    distance[distance < 0] = np.inf
    np.fill_diagonal(distance, np.inf)
    near = np.argsort(distance, axis=1, kind="stable")[:, :neighbours]
    i, k = np.repeat(np.arange(P), near.shape[1]), near.ravel()
    together = np.isfinite(distance[i, k])
    return np.unique(np.sort(np.stack([i, k], axis=-1)[together], axis=1), axis=0)
