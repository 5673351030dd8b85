"""The conformal scale of every image, from that between pairs of images."""

from __future__ import annotations

import numpy as np

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
    incidence = np.zeros((len(edges), F))
    incidence[np.arange(len(edges)), edges[:, 0]] = -1.0
    incidence[np.arange(len(edges)), edges[:, 1]] = 1.0
    # Points with the same edges share their equations.
    patterns, which = np.unique(known, axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        (points,) = np.nonzero(which.ravel() == number)
        if pattern.any():
            joined = np.unique(edges[pattern])
            s = np.linalg.lstsq(incidence[pattern], np.log(scale[np.ix_(pattern, points)]), rcond=None)[0]
            found[np.ix_(joined, points)] = s[joined]
    return found
