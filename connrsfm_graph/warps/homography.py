"""Homography between two images: the warp of a plane, and the mean of the Gaussian process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors.warp_jet import WarpJet

_GAUSS_NEWTON_STEPS = 4
_LEAST_DENOMINATOR = 0.05


@dataclass(frozen=True)
class Homography:
    """eta(x) = (A x + b) / (h . x + 1)."""

    linear: np.ndarray
    """(2, 2) A."""
    offset: np.ndarray
    """(2,) b."""
    projective: np.ndarray
    """(2,) h; zero for an affinity."""

    def denominator(self, points: np.ndarray) -> np.ndarray:
        """(N,) h . x + 1; a homography is a warp of the points only where it is positive."""
        return points @ self.projective + 1.0

    def jet(self, points: np.ndarray) -> WarpJet:
        """2-jets at points (N, 2)."""
        d = self.denominator(points)
        h = self.projective
        value = (points @ self.linear.T + self.offset) / d[:, None]
        jacobian = (self.linear - value[:, :, None] * h) / d[:, None, None]
        second = -(jacobian[..., :, None] * h + h[:, None] * jacobian[..., None, :]) / d[:, None, None, None]
        return WarpJet(value, jacobian, np.stack([second[..., 0, 0], second[..., 0, 1], second[..., 1, 1]], axis=-1))


def fit_homography(points: np.ndarray, target: np.ndarray, weight: np.ndarray) -> Homography:
    """Homography of least weighted squared distance in image b, by Gauss-Newton from the algebraic solution.

    Returns the best affinity instead where no homography keeps all points on one side of its vanishing line.

    Args:
        points, target: (P, 2), both of about unit spread.
        weight: (P,).
    """
    root = np.sqrt(weight)[:, None]
    affine_rows = np.column_stack([points, np.ones(len(points))])
    affine = np.linalg.lstsq(root * affine_rows, root * target, rcond=None)[0]
    zero = np.zeros_like(affine_rows)
    value, d = target, np.ones((len(points), 1))  # with these the first step is the algebraic solution
    for _ in range(1 + _GAUSS_NEWTON_STEPS):
        # d (eta - value) + value = rows . parameters to first order about the last parameters.
        first = np.hstack([affine_rows, zero, -value[:, :1] * points]) * root / d
        second = np.hstack([zero, affine_rows, -value[:, 1:] * points]) * root / d
        right = (d * (target - value) + value) * root / d
        parameters = np.linalg.lstsq(np.vstack([first, second]), right.T.ravel(), rcond=None)[0]
        homography = Homography(parameters[[[0, 1], [3, 4]]], parameters[[2, 5]], parameters[6:])
        d = homography.denominator(points)[:, None]
        if d.min() < _LEAST_DENOMINATOR * d.max():
            return Homography(affine[:2].T, affine[2], np.zeros(2))
        value = (points @ homography.linear.T + homography.offset) / d
    return homography
