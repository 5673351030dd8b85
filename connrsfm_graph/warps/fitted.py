"""What every fitted warp offers, whatever its model, and the errors of predicting left-out points.

Models are linear smoothers (the Schwarzian one to first order), so the error of predicting a point from all others
needs no refit: with the leverage h_p = w_p d eta(x_p) / d y_p, it is residual_p / (1 - h_p).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from factors.warp_jet import WarpJet


class FittedWarp(Protocol):
    """A warp fitted to P points of one edge, in the coordinates it was fitted in."""

    @property
    def model(self) -> str:
        """Name of the model."""

    @property
    def weight(self) -> np.ndarray:
        """(P,) weight each point had, in (0, 1]."""

    @property
    def residual(self) -> np.ndarray:
        """(P, 2) point of image b minus warp."""

    @property
    def leverage(self) -> np.ndarray:
        """(P,) how much each point determines its own prediction, in [0, 1)."""

    @property
    def noise(self) -> float:
        """Standard deviation of a coordinate of the points about the warp."""

    @property
    def settings(self) -> Mapping[str, float]:
        """Smoothing weights or hyper-parameters, by name."""

    def jet(self, points: np.ndarray, covariance: bool = True) -> WarpJet:
        """2-jets at points (N, 2) of image a."""


def leave_one_out(warp: FittedWarp) -> np.ndarray:
    """(P, 2) error of predicting each point by the warp fitted to all the others with the same settings."""
    return warp.residual / (1.0 - warp.leverage)[:, None]


def prediction_error(warp: FittedWarp) -> float:
    """Root mean square of the leave-one-out errors of a coordinate, wrong tracks weighted down as in the fit."""
    squared = (leave_one_out(warp) ** 2).mean(axis=1)
    return float(np.sqrt((warp.weight * squared).sum() / warp.weight.sum()))
