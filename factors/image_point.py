"""A tracked image point with its noise: the sight ray may be corrected, at a price in pixels.

Where the image noise matters, a point is not on the tracked ray (x, 1) but on (x + q, 1). The residual is the
correction, r = q, in normalised coordinates; divide a standard deviation in pixels by the focal length. It is linear
in its one variable, so GTSAM's own prior is the factor and no Python is called during the optimisation.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from factors.jacobian_check import Example
from factors.keys import RAY_CORRECTION, key


def image_point_factor(point: int, view: int, noise: gtsam.noiseModel.Base) -> gtsam.PriorFactorVector:
    """Keeps the ray correction of one point in one view small; `noise` is two-dimensional, normalised coordinates."""
    if noise.dim() != 2:
        raise ValueError(f"image point: noise model has dimension {noise.dim()}, expected 2")
    return gtsam.PriorFactorVector(key(RAY_CORRECTION, point, view), np.zeros(2), noise)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """One image point with a random correction, for the Jacobian check."""
    values = gtsam.Values()
    values.insert(key(RAY_CORRECTION, 4, 2), rng.normal(0.0, 0.01, 2))
    yield "image point", image_point_factor(4, 2, gtsam.noiseModel.Isotropic.Sigma(2, 0.01)), values
