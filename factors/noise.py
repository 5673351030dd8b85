"""Noise of the pair factor: one sigma per block of rows, what is known of a single pair, and a robust loss.

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
BLOCKS = {"metric": METRIC_ROWS, "intrinsic": INTRINSIC_ROWS, "extrinsic": EXTRINSIC_ROWS}
"""Rows of each block, by the name of its sigma."""


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
        for name, rows in BLOCKS.items():
            sigmas[rows] = getattr(self, name)
        return sigmas

    def precisions(self) -> np.ndarray:
        """(21,) reciprocal standard deviations; 0 for dropped blocks."""
        return 1.0 / self.sigmas()

    def model(self, weight: float = 1.0, precision: np.ndarray | None = None) -> gtsam.noiseModel.Base:
        """GTSAM noise model of a pair.

        Args:
            weight: of the pair; sigmas are divided by its root.
            precision: (21,) positive factors by which the rows of this pair are more precise than the blocks' sigmas
                say; 1 where None.
        """
        sigmas = self.sigmas() / math.sqrt(weight)
        diagonal = gtsam.noiseModel.Diagonal.Sigmas(sigmas if precision is None else sigmas / precision)
        if math.isinf(self.huber):
            return diagonal
        return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(self.huber), diagonal)
