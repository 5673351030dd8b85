"""Wrong tracks: weights of the points of an edge that agree with the warp fitted with them.

The Gaussian process serves, whichever model then gives the jets: it follows the points as closely as their noise
allows, so what it leaves is noise or a wrong track; a strongly smoothed spline leaves the shape of the surface too.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.warps.fitted import FittedWarp, leave_one_out
from connrsfm_graph.warps.gaussian_process import GaussianProcessWarp, fit_gaussian_process

# Beyond this many standard deviations a point loses weight: 3 in 10,000 of the good ones do.
_CUT = 4.0
# Errors below this fraction of the spread of the points are no wrong tracks, however exact the others.
_LEAST_SCALE = 1e-3
_MAX_ROUNDS = 10
_SETTLED = 0.1


def fit_robust(points: np.ndarray, target: np.ndarray, scales: np.ndarray) -> GaussianProcessWarp:
    """Gaussian-process warp whose weights follow from its own errors; arguments as in `fit_gaussian_process`.

    The plain fit where no point is far off. Otherwise iteratively reweighted least squares, hyper-parameters included.
    """
    weight = np.ones(len(points))
    warp = fit_gaussian_process(points, target, weight, scales)
    for _ in range(_MAX_ROUNDS):
        previous, weight = weight, robust_weights(warp)
        if np.abs(weight - previous).max() < _SETTLED:
            break
        # The best length scale moves little from round to round: look at its neighbours only.
        at = int(np.argmin(np.abs(scales - warp.settings["length_scale"])))
        warp = fit_gaussian_process(points, target, weight, scales[max(at - 1, 0) : at + 2])
    return warp


def robust_weights(warp: FittedWarp) -> np.ndarray:
    """(P,) weights from studentised leave-one-out errors: 1 up to four standard deviations, then falling as t^-2.

    The influence w t of a wrong track vanishes with its error t, and data without any keep the plain fit exactly. The
    scale is the median, which only half of the points being wrong could carry away.
    """
    # Variance of a prediction relative to the noise; dividing by 1 + it gives all points the same expected error.
    prediction = warp.leverage / (warp.weight * (1.0 - warp.leverage))
    error = np.linalg.norm(leave_one_out(warp), axis=1) / np.sqrt(1.0 + prediction)
    scale = np.median(error) / np.sqrt(2.0 * np.log(2.0))  # median of a Rayleigh distribution
    cut = _CUT * max(scale, _LEAST_SCALE)
    return (cut / np.maximum(error, cut)) ** 2
