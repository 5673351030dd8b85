"""Model and smoothing weights of a data set, chosen on a few of its edges.

The weight of a penalty is the one that predicts left-out points best. That is optimal for the values of a warp, but
reconstruction needs its second derivatives, and these ask for more smoothing: Schwarzian spline and Gaussian process
predict points about equally well where their second derivatives differ by their own size. `auto` therefore looks first
at the length scale that the evidence prefers. Above the shortest one allowed, the points are those of a smooth map and
noise, and the Gaussian process finds both. At the shortest one, the points show detail too fine for it (wrinkles, wrong
correspondences). Unless it still predicts far better than any spline, as it does for exact points, derivatives come
from a prior then, and the geometric one, a warp is locally a homography, is better founded: the Schwarzian spline, with
its customary strong weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from connrsfm_graph.warps.config import WarpConfig
from connrsfm_graph.warps.fitted import FittedWarp, prediction_error
from connrsfm_graph.warps.gaussian_process import GaussianProcessWarp, fit_gaussian_process, length_scales
from connrsfm_graph.warps.robust import fit_robust
from connrsfm_graph.warps.spline_warp import fit_spline

Probe = tuple[np.ndarray, np.ndarray, GaussianProcessWarp]
"""Points and targets of one edge in local coordinates, and the Gaussian process fitted to them."""

SCHWARZIAN_WEIGHTS = 10.0 ** np.arange(-0.5, -5.1, -0.5)
BENDING_WEIGHTS = 10.0 ** np.arange(0.0, -7.1, -0.5)
RESOLVED = 1.2
"""Length scale over the shortest one from which it counts as resolved."""
DECISIVE = 2.0
"""Ratio of prediction errors that counts as far better."""


def resolve(config: WarpConfig, probes: Sequence[Probe]) -> WarpConfig:
    """The configuration with its model named and the weight of that model given; unchanged without any probe."""
    if not probes:
        return config
    if config.model == "auto":
        spline, process = replace(config, model="schwarzian"), replace(config, model="gaussian_process")
        typical = np.median([fitted.settings["length_scale"] for _, _, fitted in probes])
        smooth = typical > RESOLVED * config.shortest_scale
        exact = not smooth and _error(_best_weight(spline, probes), probes) > DECISIVE * _error(process, probes)
        config = process if smooth or exact else spline
    if config.model != "gaussian_process" and getattr(config, config.model) is None:
        config = _best_weight(config, probes)
    return config


def is_resolved(config: WarpConfig) -> bool:
    """Whether the configuration leaves nothing to be chosen."""
    return config.model == "gaussian_process" or (config.model != "auto" and getattr(config, config.model) is not None)


def fit_process(config: WarpConfig, points: np.ndarray, target: np.ndarray) -> GaussianProcessWarp:
    """The Gaussian process of one edge, in local coordinates; it also gives the weights and the noise of the points."""
    scales = length_scales(config.shortest_scale)
    if config.robust:
        return fit_robust(points, target, scales)
    return fit_gaussian_process(points, target, np.ones(len(points)), scales)


def fit_model(config: WarpConfig, probe: Probe) -> FittedWarp:
    """The warp of one edge by the model of a resolved configuration, with the weights the Gaussian process found."""
    points, target, process = probe
    if config.model == "gaussian_process":
        return process
    bending = config.bending if config.model == "bending" else None
    schwarzian = config.schwarzian if config.model == "schwarzian" else None
    return fit_spline(points, target, process.weight, config.control_points, config.padding, bending, schwarzian)


def _error(config: WarpConfig, probes: Sequence[Probe]) -> float:
    """Geometric mean over the edges of the error of predicting left-out points."""
    errors = [prediction_error(fit_model(config, probe)) for probe in probes]
    return float(np.exp(np.mean(np.log(np.maximum(errors, 1e-12)))))


def _best_weight(config: WarpConfig, probes: Sequence[Probe]) -> WarpConfig:
    """The spline configuration with the weight of its penalty that predicts best."""
    if config.model == "schwarzian":
        candidates = [replace(config, schwarzian=float(weight)) for weight in SCHWARZIAN_WEIGHTS]
    else:
        candidates = [replace(config, bending=float(weight)) for weight in BENDING_WEIGHTS]
    return min(candidates, key=lambda candidate: _error(candidate, probes))
