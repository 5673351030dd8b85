"""Surfaces are seen frontally: a prior on the slant of what a camera sees, for data that tell little about it.

Of a surface whose patches lie in all directions alike, what is seen at a random image point has slant theta with a
density proportional to cos(theta)^4 over the slopes of depth: cos(theta)^3 is the solid angle of a slope, and a patch
fills cos(theta) of its area in the image. N independent patches in a view so add -4 N log cos(theta) to the cost, on
average over them. Chords of a patch are foreshortened by -log((1 + cos(theta)) / 2) on average over their directions,
half of -log cos(theta) to second order, so that the same prior is

    C = 8 N / E sum over the E edges of e - (b_i + b_k) / 2 - log |x_i - x_k|,

with e the log length of the edge, b the log depths of its ends and x their tracked image points. A mean that counts
loose edges less does as well, and must where nothing else would keep them from collapsing. It is linear, a number
more in the gradient and nothing in the Hessian, and moves shapes most along what the data leave open. It is the
maximum-depth heuristic (Perriollat, Hartley and Bartoli 2011) as a prior. Patches count as independent in every view:
of a slant that all views have in common, as before a camera at rest, it is too sure.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numba import njit

from factors.keys import LOG_DEPTH, LOG_LENGTH, key

PER_PATCH = 8.0
"""Cost of a unit of mean log foreshortening, for every independent patch."""


@njit(cache=True, inline="always")
def log_foreshortening_kernel(u, v, b_i, b_k, e):
    """Log ratio of an edge's length to that of a frontal edge, for the difference (u, v) of its image points.

    The derivatives by b_i, b_k and e are -1/2, -1/2 and 1 everywhere.
    """
    return e - 0.5 * (b_i + b_k + np.log(max(u * u + v * v, 1e-24)))


def frontal_factor(
    edge: int, point_i: int, point_k: int, view: int, image_i: np.ndarray, image_k: np.ndarray, weight: float
) -> gtsam.LinearContainerFactor:
    """The foreshortening of mesh edge `edge` in one view.

    Args:
        edge, point_i, point_k, view: indices of the variables: log depths of both points in the view, and the log
            length of the edge.
        image_i, image_k: (2,) tracked points, normalised coordinates.
        weight: 8 N / E, for N independent patches and E edges a view (see `PER_PATCH`), or a share of the same sum.

    Returns:
        A factor whose error is linear and may be negative. GTSAM eliminates it by Cholesky, its default, not by QR,
        together with factors that hold the variables.
    """
    u, v = np.asarray(image_i, dtype=float) - image_k
    keys = key(LOG_DEPTH, point_i, view), key(LOG_DEPTH, point_k, view), key(LOG_LENGTH, edge)
    values, none, half = gtsam.Values(), np.zeros((1, 1)), np.array([0.5 * weight])
    for k in keys:
        values.insert(k, np.zeros(1))
    at_zero = 2.0 * weight * log_foreshortening_kernel(u, v, 0.0, 0.0, 0.0)
    linear = gtsam.HessianFactor(*keys, none, none, none, half, none, none, half, none, -2.0 * half, at_zero)
    return gtsam.LinearContainerFactor(linear, values)
