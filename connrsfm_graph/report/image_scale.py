"""The conformal scale of every image, from that between pairs of images."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from connrsfm_graph.reconstruction import Reconstruction


def log_image_scale(reconstruction: Reconstruction) -> np.ndarray:
    """(F, P) log of how much larger the surface around a point is in an image than on average, NaN where unknown.

    The scale lambda of an edge from image a to image b is the ratio of those of its images, log lambda = s_b - s_a: a
    least squares problem per point on the image graph. The mean of s over the images a point's edges join is zero.
    """
    edges, scale = reconstruction.edges, reconstruction.conformal_scale
    F, P = reconstruction.visible.shape
    found = np.full((F, P), np.nan)
    known = np.isfinite(scale) & (scale > 0)
    if not known.any():
        return found
    ends, rows = np.concatenate([edges[:, 0], edges[:, 1]]), np.tile(np.arange(len(edges)), 2)
    incidence = csr_array((np.repeat([-1.0, 1.0], len(edges)), (rows, ends)), shape=(len(edges), F))
    # Points with the same edges share their equations.
    patterns, which = np.unique(known, axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        (points,) = np.nonzero(which.ravel() == number)
        if pattern.any():
            joined = np.unique(edges[pattern])
            differences = incidence[np.flatnonzero(pattern)][:, joined]
            found[np.ix_(joined, points)] = _potentials(differences, np.log(scale[np.ix_(pattern, points)]))
    return found


def _potentials(differences: csr_array, values: np.ndarray) -> np.ndarray:
    """(N, M) least squares solutions of mean zero in each connected part, of which `differences` (E, N) are to be
    `values` (E, M)."""
    laplacian = csc_array(differences.T @ differences)
    n_parts, part = connected_components(laplacian, directed=False)
    _, first = np.unique(part, return_index=True)
    held = csc_array((np.ones(n_parts), (first, first)), shape=laplacian.shape)
    s = splu(laplacian + held).solve(differences.T @ values)  # zero where held, as the right side sums to zero
    of_part = csr_array((np.ones(len(part)), (part, np.arange(len(part)))))
    return s - (of_part @ s / of_part.sum(axis=1)[:, None])[part]
