"""Noise of the tracks, estimated from the tracks alone."""

from __future__ import annotations

import numpy as np

from connrsfm_graph.warps.config import WarpConfig
from connrsfm_graph.warps.fit import Warps, fit_warps

# A warp's finest detail counts as noise in its derivatives, but not when noise itself is asked for.
_CONFIG = WarpConfig(model="gaussian_process", shortest_scale=0.3, covariance=False)


def estimate_pixel_noise(image: np.ndarray, visible: np.ndarray, edges: np.ndarray, max_edges: int = 6) -> float:
    """Standard deviation of a coordinate of the tracked points, in normalised image coordinates.

    Gaussian-process warps of a few edges give the noise s_n of image b about the warp. It holds the noise of both
    images, that of image a seen through the Jacobian: s_n^2 = sigma^2 (1 + |J|_F^2 / 2). The result is the median over
    edges. For noise-free tracks it is the detail that no smooth warp explains, an upper bound.

    Args:
        image, visible, edges: as in `fit_warps`.
        max_edges: edges to use, spread evenly over the list.

    Returns:
        sigma; NaN where no edge has a usable warp.
    """
    edges = np.asarray(edges)
    some = np.unique(np.linspace(0, len(edges) - 1, min(max_edges, len(edges))).round().astype(int))
    return pixel_noise(fit_warps(image, visible, edges[some], _CONFIG))


def pixel_noise(warps: Warps) -> float:
    """The same estimate from warps already fitted."""
    estimates = []
    for e, report in enumerate(warps.reports):
        if report.usable:
            stretch = (warps.jets.jacobian[e, warps.valid[e]] ** 2).sum(axis=(1, 2))
            estimates.append(warps.noise[e] / np.sqrt(1.0 + np.median(stretch) / 2.0))
    return float(np.median(estimates)) if estimates else float("nan")
