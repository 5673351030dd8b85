"""Noise levels of the refinement, updated by what a fit shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

_LEAST_IMAGE = 1e-4
"""Smallest image noise, relative to the median image length of a mesh edge."""
_OVERESTIMATED = 0.7
"""Corrections below this part of the assumed image noise show that it was assumed too large."""
_HUBER = (0.25, 2.0, 1.0)
"""Robust threshold of the length residuals: at least, in units of their own robust standard deviation, at most."""
_RELEASE = 10.0
"""After the first fit an interpolated image point is held by so much less than its uncertainty says."""
_SETTLED = 0.1
_GROSS = (5.0, 0.1)
"""A track is wrong beyond so many standard deviations, and this part of an edge's median image length."""
_RAYLEIGH = 1.1774
"""Median of the norm of a plane Gaussian vector of unit standard deviation."""


@dataclass(frozen=True)
class Noise:
    """What a fit assumes."""

    sigma: float
    """Standard deviation of a coordinate of the image points, normalised coordinates."""
    spacing: float
    """Median image length of a mesh edge."""
    huber: float = _HUBER[2]
    """Length residuals count linearly beyond this, in units of the assumed standard deviation."""
    release: float = 1.0
    """Factor on the uncertainty of interpolated image points."""

    @staticmethod
    def start(sigma: float, spacing: float) -> Noise:
        """For an estimate of the image noise, NaN where there is none."""
        return Noise(max(sigma if np.isfinite(sigma) else 0.0, _LEAST_IMAGE * spacing), spacing)

    def image_weight(self, seen: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """(F, P) inverse standard deviations of seen and interpolated image points."""
        return 1.0 / np.where(seen, self.sigma, np.maximum(self.sigma, self.release * deviation))

    def updated(self, correction: np.ndarray, residual: np.ndarray) -> Noise:
        """After a fit.

        The image noise given is an upper bound (a warp's misfit is not all noise), so it is only ever lowered.

        Args:
            correction: (N, 2) ray corrections of the seen points.
            residual: length residuals in units of their assumed standard deviation.
        """
        shown = float(np.sqrt((correction**2).mean()))
        sigma = max(shown, _LEAST_IMAGE * self.spacing) if shown < _OVERESTIMATED * self.sigma else self.sigma
        least, factor, most = _HUBER
        huber = float(np.clip(factor * 1.4826 * np.median(np.abs(residual)), least, most))
        return replace(self, sigma=sigma, huber=huber, release=_RELEASE)

    def settled(self, last: Noise) -> bool:
        """Whether another fit would change little."""
        return (
            self.release == last.release
            and abs(self.sigma - last.sigma) <= _SETTLED * last.sigma
            and abs(self.huber - last.huber) <= _SETTLED * last.huber
        )

    def gross(self, size: np.ndarray) -> float:
        """Length (N,) beyond which a ray correction means a wrong track."""
        return max(_GROSS[0] * float(np.median(size)) / _RAYLEIGH, _GROSS[1] * self.spacing)
