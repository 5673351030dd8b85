"""A surface's mesh laid out in the plane by the lengths of its edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu

from connrsfm_graph.refine.mesh import Mesh

_ITERATIONS = 30
_HELD = 1e-9
"""Weight, relative to the edges', that holds the places of parts that hang together with nothing."""


def flattened(mesh: Mesh, log_length: np.ndarray) -> Mesh:
    """The mesh with positions whose distances are, as well as a plane allows, the lengths of the edges.

    Relative errors of the lengths are made small by majorisation (de Leeuw 1977; Gansner, Koren and North 2005): each
    iteration solves one sparse linear system, always of the same matrix, and none raises their sum of squares.

    Args:
        mesh: positions to start from.
        log_length: (E,).
    """
    i, k = mesh.edges.T
    length = np.exp(log_length)
    weight = 1.0 / length**2
    distance = np.maximum(np.linalg.norm(mesh.position[i] - mesh.position[k], axis=1), np.finfo(float).tiny)
    position = mesh.position * np.exp(np.median(log_length - np.log(distance)))
    held = _HELD * weight.mean()
    system = splu((_laplacian(mesh, weight) + sparse.diags_array(np.full(mesh.n_points, held))).tocsc())
    for _ in range(_ITERATIONS):
        distance = np.maximum(np.linalg.norm(position[i] - position[k], axis=1), np.finfo(float).tiny)
        position = system.solve(_laplacian(mesh, weight * length / distance) @ position + held * position)
    return replace(mesh, position=position)


def _laplacian(mesh: Mesh, weight: np.ndarray) -> sparse.csr_array:
    """(P, P) graph Laplacian of the edges with weights (E,)."""
    graph = sparse.coo_array((weight, tuple(mesh.edges.T)), shape=(mesh.n_points, mesh.n_points))
    return csgraph.laplacian(graph.tocsr(), symmetrized=True)
