"""Local coordinates of one image of an edge: the shared points moved to zero mean and scaled to unit spread.

Penalty weights and length scales then mean the same for every image and every unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors.warp_jet import JET_SIZE, WarpJet


@dataclass(frozen=True)
class LocalCoordinates:
    """x_local = (x - centre) / spread."""

    centre: np.ndarray
    """(2,) mean of the points."""
    spread: float
    """Root mean square of the coordinates about the mean."""

    @staticmethod
    def of(points: np.ndarray) -> LocalCoordinates:
        """From points (P, 2); points all at one place give spread zero."""
        centre = points.mean(axis=0)
        return LocalCoordinates(centre, float(np.sqrt(((points - centre) ** 2).mean())))

    def to_local(self, points: np.ndarray) -> np.ndarray:
        return (points - self.centre) / self.spread


def jet_from_local(jet: WarpJet, a: LocalCoordinates, b: LocalCoordinates) -> WarpJet:
    """A jet between the local coordinates of images a and b, in the coordinates of the images (chain rule)."""
    first, second = b.spread / a.spread, b.spread / a.spread**2
    covariance = jet.covariance
    if covariance is not None:
        scale = np.array([first] * 4 + [second] * (JET_SIZE - 4))
        covariance = covariance * np.outer(scale, scale)
    return WarpJet(jet.value * b.spread + b.centre, jet.jacobian * first, jet.hessian * second, covariance)
