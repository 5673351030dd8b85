"""What the covariance of a warp's 2-jet means for the 21 rows of the conformal pair.

To first order the covariance of the rows is D C D^T with C that of the jet and D the rows' derivatives by the ten
numbers of the jet. Every row is a polynomial of degree at most two in each one of them, so that a central difference
of any width is the derivative itself.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from factors.conformal_pair import COLUMNS, pair_kernel, pair_workspace
from factors.noise import ROWS
from factors.surface import PERSPECTIVE, Camera
from factors.warp_jet import JET_SIZE, PAIR_DATA_SIZE

_STEP = 0.1


@njit(cache=True)
def jet_derivatives(data, ya, yb, log_rho, kappa, scratch, D):
    """Derivatives D (21, 10) of the rows of one pair by the jet; arguments as for `conformal_pair.pair_kernel`."""
    (G, dG), moved, plus, minus, J = scratch
    moved[:] = data
    for k in range(JET_SIZE):
        at = PAIR_DATA_SIZE - JET_SIZE + k
        moved[at] = data[at] + _STEP
        pair_kernel(moved, ya, yb, log_rho, kappa, G, dG, plus, J, False)
        moved[at] = data[at] - _STEP
        pair_kernel(moved, ya, yb, log_rho, kappa, G, dG, minus, J, False)
        moved[at] = data[at]
        for i in range(ROWS):
            D[i, k] = (plus[i] - minus[i]) / (2.0 * _STEP)


@njit(cache=True, parallel=True)
def _variances(data, ya, yb, log_rho, covariance, kappa, variance):
    for n in prange(len(data)):
        scratch = pair_workspace(), np.empty(PAIR_DATA_SIZE), np.empty(ROWS), np.empty(ROWS), np.empty((ROWS, COLUMNS))
        D = np.empty((ROWS, JET_SIZE))
        jet_derivatives(data[n], ya[n], yb[n], log_rho[n], kappa, scratch, D)
        for i in range(ROWS):
            total = 0.0
            for k in range(JET_SIZE):
                for m in range(JET_SIZE):
                    total += D[i, k] * covariance[n, k, m] * D[i, m]
            variance[n, i] = max(total, 0.0)


def row_variances(
    data: np.ndarray,
    ya: np.ndarray,
    yb: np.ndarray,
    log_rho: np.ndarray,
    covariance: np.ndarray,
    camera: Camera = PERSPECTIVE,
) -> np.ndarray:
    """(N, 21) variances of the rows of N pairs that follow from the covariance of their jets.

    Args:
        data: (N, 14) pair data, see `factors.warp_jet`.
        ya, yb: (N, 5) first- and second-order terms of the two images.
        log_rho: (N,) log lambda + kappa (log beta_b - log beta_a).
        covariance: (N, 10, 10) of the jets, see `factors.warp_jet.WarpJet`.
        camera: camera model.
    """
    variance = np.empty((len(data), ROWS))
    data, ya, yb, log_rho, covariance = (
        np.ascontiguousarray(array, dtype=float) for array in (data, ya, yb, log_rho, covariance)
    )
    _variances(data, ya, yb, log_rho, covariance, camera.kappa, variance)
    return variance
