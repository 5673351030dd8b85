"""By how much homogeneous strains of the views change the log lengths of the mesh's edges."""

from __future__ import annotations

import numpy as np
from numba import njit

from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.threads import over_views
from factors.edge_length import stretch_kernel


def stretches(strain: np.ndarray, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Changes (F, E) of log lengths, and their derivatives (F, E, K) by the strains.

    Args:
        strain: (F, K) strains of the views, K = 2, or K = 0 where they are not stretched.
        mesh: of the surface, laid out in the plane; from its positions are the directions of the edges.
    """
    (F, K), E = strain.shape, len(mesh.edges)
    change, derivative = np.zeros((F, E)), np.empty((F, E, K))
    if K:
        over_views(_stretch_kernel, F, strain, mesh.direction, change, derivative)
    return change, derivative


@njit(cache=True, nogil=True)
def _stretch_kernel(first, last, strain, direction, change, derivative):
    for f in range(first, last):
        for e in range(len(direction)):
            change[f, e], derivative[f, e, 0], derivative[f, e, 1] = stretch_kernel(
                strain[f, 0], strain[f, 1], direction[e, 0], direction[e, 1]
            )
