"""Conformal factors that vary slowly: neighbours on the surface have similar log conformal factors.

The residual r = f_i - f_k over a mesh edge of one view is linear, so GTSAM's own difference factor is used. Its weight
decides between reconstructions that the images alone cannot tell apart: inverting a view about the camera centre
changes f by -2 log |X| and nothing else, so the assumption "f varies least" belongs to every reported factor.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from factors.jacobian_check import Example
from factors.keys import LOG_FACTOR, key


def scale_smoothness_factor(
    point_i: int, point_k: int, view: int, noise: gtsam.noiseModel.Base
) -> gtsam.BetweenFactorVector:
    """Log conformal factors of two neighbouring points of a view, equal up to one-dimensional `noise`."""
    if noise.dim() != 1:
        raise ValueError(f"scale smoothness: noise model has dimension {noise.dim()}, expected 1")
    return gtsam.BetweenFactorVector(key(LOG_FACTOR, point_k, view), key(LOG_FACTOR, point_i, view), np.zeros(1), noise)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """Two neighbours with random factors, for the Jacobian check."""
    values = gtsam.Values()
    for point in (3, 5):
        values.insert(key(LOG_FACTOR, point, 1), rng.normal(0.0, 0.3, 1))
    yield "neighbours", scale_smoothness_factor(3, 5, 1, gtsam.noiseModel.Isotropic.Sigma(1, 0.2)), values
