"""Scales of two views: the reconstruction's unit drifts slowly, so neighbouring views have similar log scales.

The residual g_b - g_a is linear, so GTSAM's own difference factor is used and no Python runs in the optimisation.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from factors.jacobian_check import Example
from factors.keys import VIEW_SCALE, key


def scale_link_factor(
    views: tuple[int, int], noise: gtsam.noiseModel.Base, log_ratio: float = 0.0
) -> gtsam.BetweenFactorVector:
    """Log scale of views[1] less that of views[0] is `log_ratio` up to one-dimensional `noise`."""
    if noise.dim() != 1:
        raise ValueError(f"scale link: noise model has dimension {noise.dim()}, expected 1")
    first, second = (key(VIEW_SCALE, 0, view) for view in views)
    return gtsam.BetweenFactorVector(first, second, np.array([log_ratio]), noise)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """Two views with random scales, for the Jacobian check."""
    values = gtsam.Values()
    for view in (3, 7):
        values.insert(key(VIEW_SCALE, 0, view), rng.normal(0.0, 0.3, 1))
    yield "two views", scale_link_factor((3, 7), gtsam.noiseModel.Isotropic.Sigma(1, 0.05), 0.1), values
