"""What every fitted warp offers, whatever its model, and what follows from it: robust weights and prediction errors.

Models are linear smoothers (the Schwarzian one to first order), so the error of predicting a point from all others
needs no refit: with the leverage h_p = w_p d eta(x_p) / d y_p, it is residual_p / (1 - h_p).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from factors.warp_jet import WarpJet

# Beyond this many standard deviations a point loses weight: 3 in 10,000 of the good ones do.
_CUT = 4.0
_MAX_ROUNDS = 8


class FittedWarp(Protocol):
    """A warp fitted to P points of one edge, in the coordinates it was fitted in."""

    model: str
    """Name of the model."""
    weight: np.ndarray
    """(P,) weight each point had, in (0, 1]."""
    residual: np.ndarray
    """(P, 2) point of image b minus warp."""
    leverage: np.ndarray
    """(P,) how much each point determines its own prediction, in [0, 1)."""
    noise: float
    """Standard deviation of a coordinate of the points about the warp."""
    settings: Mapping[str, float]
    """Smoothing weights or hyper-parameters, by name."""

    def jet(self, points: np.ndarray, covariance: bool = True) -> WarpJet:
        """2-jets at points (N, 2) of image a."""
        ...


def leave_one_out(warp: FittedWarp) -> np.ndarray:
    """(P, 2) error of predicting each point by the warp fitted to all the others with the same settings."""
    return warp.residual / (1.0 - warp.leverage)[:, None]


def prediction_error(warp: FittedWarp) -> float:
    """Root mean square of the leave-one-out errors of a coordinate, wrong tracks weighted down as in the fit."""
    squared = (leave_one_out(warp) ** 2).mean(axis=1)
    return float(np.sqrt((warp.weight * squared).sum() / warp.weight.sum()))


def robust_weights(warp: FittedWarp) -> np.ndarray:
    """(P,) weights from studentised leave-one-out errors: 1 up to four standard deviations, then falling as t^-2.

    The influence w t of a wrong track then vanishes with its error, and data without any keep the plain fit exactly.
    The scale is the median, which half of the points being wrong cannot move.
    """
    # Variance of a prediction relative to the noise; dividing by 1 + it gives all points the same expected error.
    prediction = warp.leverage / (warp.weight * (1.0 - warp.leverage))
    error = np.linalg.norm(leave_one_out(warp), axis=1) / np.sqrt(1.0 + prediction)
    scale = np.median(error) / np.sqrt(2.0 * np.log(2.0))  # Rayleigh distribution
    return np.minimum(1.0, (_CUT * scale / np.maximum(error, 1e-300)) ** 2)


def fit_robust(fit: Callable[[np.ndarray], FittedWarp], n_points: int) -> FittedWarp:
    """Fit with weights that agree with the fit.

    Args:
        fit: fits a warp given weights (P,).
        n_points: P.
    """
    weight = np.ones(n_points)
    warp = fit(weight)
    for _ in range(_MAX_ROUNDS):
        previous, weight = weight, robust_weights(warp)
        if np.abs(weight - previous).max() < 0.1:
            break
        warp = fit(weight)
    return warp
