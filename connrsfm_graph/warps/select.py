"""Model and smoothing weights of a data set, chosen by how well left-out points are predicted on a few of its edges.

Predicting points is not the same as knowing second derivatives, which the reconstruction needs: a smoothing that is
optimal for the value of a warp is too rough for its derivatives. The rule for `auto` allows for that. Where points are
noisy or sparse, Schwarzian spline and Gaussian process, both at their best, predict about equally well, and the
geometric prior (a warp is locally a homography) decides: the spline, with its customary strong weight. Only where the
Gaussian process predicts far better are the data smooth and clean enough to show their second derivatives themselves.
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
BENDING_WEIGHTS = 10.0 ** np.arange(-2.0, -7.1, -0.5)
CLEAN_RATIO = 2.0
"""`auto` takes the Gaussian process where the best spline's prediction error is at least this many times larger."""


def resolve(config: WarpConfig, probes: Sequence[Probe]) -> WarpConfig:
    """The configuration with its model named and the weight of that model given; unchanged without any probe."""
    if not probes:
        return config
    if config.model == "auto":
        spline, process = replace(config, model="schwarzian"), replace(config, model="gaussian_process")
        clean = _error(_best_weight(spline, probes), probes) > CLEAN_RATIO * _error(process, probes)
        config = process if clean else spline
    if config.model != "gaussian_process" and getattr(config, config.model) is None:
        config = _best_weight(config, probes)
    return config


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
