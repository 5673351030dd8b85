"""Noise of the pair factor: one sigma per block of rows, an edge weight and a robust loss.

Theorem 1 treats rotation and scale as locally constant, so its rows are not equally true (measured at the exact
truth): metric rows hold for every conformal map, the intrinsic connection rows for isometries, the extrinsic rows
(second fundamental form) for similarities. Blocks therefore have sigmas of their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

ROWS = 21
_K = 9 * np.arange(2)[:, None]
INTRINSIC_ROWS = np.sort((_K + np.array([0, 1, 3, 4, 8])).ravel())
"""2 x 2 block of the connections and the (3, 3) entry, which is its trace."""
EXTRINSIC_ROWS = np.sort((_K + np.array([2, 5, 6, 7])).ravel())
"""Rows that carry the second fundamental form: the eight of Corollary 2 that depend on the scale."""
METRIC_ROWS = np.array([18, 19, 20])


@dataclass(frozen=True)
class PairNoise:
    """Standard deviations of the three blocks; `inf` drops a block exactly."""

    metric: float = 1.0
    """Sigma of the metric rows."""
    intrinsic: float = 1.0
    """Sigma of the intrinsic connection rows."""
    extrinsic: float = 1.0
    """Sigma of the extrinsic connection rows."""
    huber: float = math.inf
    """Huber threshold on the norm of the whole whitened 21-vector; infinite for least squares."""

    def __post_init__(self) -> None:
        for name in ("metric", "intrinsic", "extrinsic", "huber"):
            if not getattr(self, name) > 0:
                raise ValueError(f"pair noise: {name} must be positive, got {getattr(self, name)}")

    def sigmas(self) -> np.ndarray:
        """(21,) standard deviations in row order."""
        sigmas = np.empty(ROWS)
        sigmas[METRIC_ROWS] = self.metric
        sigmas[INTRINSIC_ROWS] = self.intrinsic
        sigmas[EXTRINSIC_ROWS] = self.extrinsic
        return sigmas

    def precisions(self) -> np.ndarray:
        """(21,) reciprocal standard deviations; 0 for dropped blocks."""
        return 1.0 / self.sigmas()

    def model(self, weight: float = 1.0) -> gtsam.noiseModel.Base:
        """GTSAM noise model of a pair on an edge of the given weight (sigmas are divided by its root)."""
        diagonal = gtsam.noiseModel.Diagonal.Sigmas(self.sigmas() / math.sqrt(weight))
        if math.isinf(self.huber):
            return diagonal
        return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(self.huber), diagonal)
