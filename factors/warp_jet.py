"""The 2-jet of an image warp: value, first and second derivatives at a point.

A warp eta maps normalised coordinates of image a to those of image b. The pair factors use it as one vector of 14
numbers per point and edge, `pair_data`:

    u_a, v_a, u_b, v_b, J11, J12, J21, J22, eta1_uu, eta1_uv, eta1_vv, eta2_uu, eta2_uv, eta2_vv

with J_lk = d eta_l / d x_k, x = (u_a, v_a). The last ten are the jet without its value; where a covariance of the jet
is known it belongs to these ten, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PAIR_DATA_SIZE = 14
JET_SIZE = 10


@dataclass(frozen=True)
class WarpJet:
    """2-jets of warps at any number of points (leading dimensions ...)."""

    value: np.ndarray
    """(..., 2) eta, normalised coordinates in image b."""
    jacobian: np.ndarray
    """(..., 2, 2) J[l, k] = d eta_l / d x_k."""
    hessian: np.ndarray
    """(..., 2, 3) second derivatives of eta_l: uu, uv, vv."""
    covariance: np.ndarray | None = None
    """(..., 10, 10) covariance of (J11, J12, J21, J22, eta1_uu, eta1_uv, eta1_vv, eta2_uu, eta2_uv, eta2_vv)."""

    def derivatives(self) -> np.ndarray:
        """(..., 10) first and second derivatives in the order of `pair_data`."""
        lead = self.jacobian.shape[:-2]
        return np.concatenate([self.jacobian.reshape(*lead, 4), self.hessian.reshape(*lead, 6)], axis=-1)

    def pair_data(self, image_a: np.ndarray, image_b: np.ndarray) -> np.ndarray:
        """(..., 14) data of the pair factors; `image_b` may be the tracked point or the warp's value."""
        return np.concatenate([image_a, image_b, self.derivatives()], axis=-1)
