"""Triangles between the tracked points of an image, so that a set of points can be seen as a surface."""

from __future__ import annotations

import numpy as np

from connrsfm_graph.refine.mesh import triangulate

LONGEST_RADIUS = 4.0
"""Triangles whose circumscribed circle is larger than this many times the median one bridge gaps and are left out."""


def triangles(image: np.ndarray) -> np.ndarray:
    """Delaunay triangles (T, 3) of image points (P, 2), without those that bridge gaps or lie along the hull.

    Rows of `image` that are NaN belong to no triangle; fewer than three points, or points on a line, give none.
    """
    (known,) = np.nonzero(np.isfinite(image).all(axis=1))
    found = triangulate(image[known])
    if not len(found):
        return found
    corners = image[known][found]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice_area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    radius = sides.prod(axis=1) / np.maximum(2.0 * twice_area, np.finfo(float).tiny)
    return known[found[radius <= LONGEST_RADIUS * np.median(radius)]]
