"""Model and smoothing weights of a data set, chosen by how well left-out points are predicted on a few of its edges.

Predicting points is not the same as knowing second derivatives, which the reconstruction needs: a smoothing that is
optimal for the value of a warp is too rough for its derivatives. The rule for `auto` allows for that. Where points are
noisy or sparse, Schwarzian spline and Gaussian process, both at their best, predict about equally well, and the
geometric prior (a warp is locally a homography) decides: the spline, with its customary strong weight. Only where the
Gaussian process predicts far better are the data smooth and clean enough to show their second derivatives themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from connrsfm_graph.warps.config import WarpConfig
from connrsfm_graph.warps.fitted import FittedWarp, fit_robust, prediction_error
from connrsfm_graph.warps.gaussian_process import fit_gaussian_process
from connrsfm_graph.warps.spline_warp import fit_spline

Fit = Callable[[np.ndarray, np.ndarray, np.ndarray], FittedWarp]
"""(points, target, weight) in local coordinates to a fitted warp."""
Probe = tuple[np.ndarray, np.ndarray]
"""Points and targets of one edge in local coordinates."""

SCHWARZIAN_WEIGHTS = 10.0 ** np.arange(-0.5, -5.1, -0.5)
BENDING_WEIGHTS = 10.0 ** np.arange(-2.0, -7.1, -0.5)
CLEAN_RATIO = 2.0
"""`auto` takes the Gaussian process where the best spline's prediction error is at least this many times larger."""


def resolve(config: WarpConfig, probes: Sequence[Probe]) -> WarpConfig:
    """The configuration with its model named and the weight of that model given."""
    if config.model == "auto":
        best = replace(config, model="schwarzian", schwarzian=_best_weight(config, "schwarzian", probes))
        process = replace(config, model="gaussian_process")
        clean = _error(best, probes) > CLEAN_RATIO * _error(process, probes)
        config = process if clean else replace(config, model="schwarzian")
    if config.model in ("schwarzian", "bending") and getattr(config, config.model) is None:
        weight = _best_weight(config, config.model, probes)
        config = replace(config, **{config.model: weight})
    return config


def fitter(config: WarpConfig) -> Fit:
    """The fit of a resolved configuration."""
    if config.model == "gaussian_process":
        return partial(fit_gaussian_process, shortest_scale=config.shortest_scale)
    return partial(
        fit_spline,
        control_points=config.control_points,
        padding=config.padding,
        **{config.model: getattr(config, config.model)},
    )


def fit_points(config: WarpConfig, points: np.ndarray, target: np.ndarray) -> FittedWarp:
    """Fit one edge with a resolved configuration, in local coordinates."""
    fit = fitter(config)
    if not config.robust:
        return fit(points, target, np.ones(len(points)))
    return fit_robust(lambda weight: fit(points, target, weight), len(points))


def _error(config: WarpConfig, probes: Sequence[Probe]) -> float:
    """Geometric mean over the edges of the error of predicting left-out points."""
    errors = [prediction_error(fit_points(config, *probe)) for probe in probes]
    return float(np.exp(np.mean(np.log(np.maximum(errors, 1e-12)))))


def _best_weight(config: WarpConfig, model: str, probes: Sequence[Probe]) -> float:
    weights = SCHWARZIAN_WEIGHTS if model == "schwarzian" else BENDING_WEIGHTS
    errors = [_error(replace(config, model=model, **{model: float(w)}), probes) for w in weights]
    return float(weights[int(np.argmin(errors))])
