"""A spline warp fitted to the points of one edge, with its leverages, noise and jet covariance.

Read as Bayes' rule, the penalties are the negative log of a prior and the normal matrix A of the (last) Gauss-Newton
step is the posterior precision: the control points have covariance (noise^2 / P) A^-1. A point and its jet involve the
16 control points around it, whose block of A^-1 lies inside the band.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky_banded

from connrsfm_graph.warps.banded import inverse_in_band, patch_blocks
from connrsfm_graph.warps.basis import UU, UV, VALUE, VV, SplineGrid, U, V
from connrsfm_graph.warps.bending import bending_band, data_equations, fit_bending
from connrsfm_graph.warps.schwarzian import fit_schwarzian
from factors.warp_jet import WarpJet

# Bending weights: of the start of the Schwarzian fit, and of its cells without points.
_START_BENDING = 1e-3
_FLOOR_BENDING = 1e-6


@dataclass(frozen=True)
class SplineWarp:
    """A fitted spline; see `connrsfm_graph.warps.fitted.FittedWarp`."""

    model: str
    settings: Mapping[str, float]
    grid: SplineGrid
    control: np.ndarray
    """(n * n, 2) control points."""
    lower: np.ndarray
    """(N, b + 1) Cholesky factor of the normal matrix, in band storage."""
    points: np.ndarray
    """(P, 2) points of image a."""
    weight: np.ndarray
    residual: np.ndarray

    @cached_property
    def inverse(self) -> np.ndarray:
        """(N, b + 1) band of the inverse of the normal matrix."""
        return inverse_in_band(self.lower)

    @cached_property
    def leverage(self) -> np.ndarray:
        first, rows = self.grid.rows(self.points)
        block = patch_blocks(self.inverse, first, self.grid.n).reshape(-1, 16, 2, 16, 2)
        own = np.einsum("pk,pkcmc,pm->p", rows[:, VALUE], block, rows[:, VALUE], optimize=True) / 2.0
        return np.minimum(self.weight * own / len(self.points), 1.0 - 1e-9)

    @cached_property
    def noise(self) -> float:
        freedom = max(2.0 * (len(self.points) - self.leverage.sum()), 1.0)
        return float(np.sqrt((self.weight[:, None] * self.residual**2).sum() / freedom))

    def jet(self, points: np.ndarray, covariance: bool = True) -> WarpJet:
        values = self.grid.evaluate(self.control, points)
        jacobian = np.stack([values[:, U], values[:, V]], axis=-1)
        hessian = np.stack([values[:, UU], values[:, UV], values[:, VV]], axis=-1)
        return WarpJet(values[:, VALUE], jacobian, hessian, self._covariance(points) if covariance else None)

    def _covariance(self, points: np.ndarray) -> np.ndarray:
        """(N, 10, 10) covariance of the jets in the order of `WarpJet.covariance`."""
        first, rows = self.grid.rows(points)
        select = np.zeros((len(points), 10, 16, 2))
        for component, start in ((0, 0), (1, 2)):
            select[:, start : start + 2, :, component] = rows[:, [U, V]]
        for component, start in ((0, 4), (1, 7)):
            select[:, start : start + 3, :, component] = rows[:, [UU, UV, VV]]
        of_control = select.reshape(len(points), 10, 32)
        block = patch_blocks(self.inverse, first, self.grid.n)
        return self.noise**2 / len(self.points) * (of_control @ block @ of_control.swapaxes(1, 2))


def fit_spline(
    points: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    control_points: int,
    padding: float,
    bending: float | None = None,
    schwarzian: float | None = None,
) -> SplineWarp:
    """Fit a spline with least bending or, where `schwarzian` is given, least Schwarzian penalty.

    Args:
        points, target: (P, 2) in image a and in image b, both of about unit spread.
        weight: (P,) in (0, 1].
        control_points, padding: as in `WarpConfig`.
        bending, schwarzian: the weight of one of the two.
    """
    grid = SplineGrid.around(points, control_points, padding)
    settings: dict[str, float] = {"control_points": control_points}
    if schwarzian is None:
        assert bending is not None
        model, settings["bending"] = "bending", bending
        control = fit_bending(grid, points, target, weight, bending)
        band, _ = data_equations(grid, points, target, weight)
        lower = np.ascontiguousarray(cholesky_banded((band + bending * bending_band(grid)).T, lower=True).T)
    else:
        model, settings["schwarzian"] = "schwarzian", schwarzian
        start = fit_bending(grid, points, target, weight, _START_BENDING)
        control, lower, steps = fit_schwarzian(grid, points, target, weight, schwarzian, _FLOOR_BENDING, start)
        settings["steps"] = steps
    residual = target - grid.evaluate(control, points)[:, VALUE]
    return SplineWarp(model, settings, grid, control, lower, points, weight, residual)
