"""Closed-form conformal scale of a pair, everything else given (Corollary 2).

Eleven of the 21 rows depend on the scale: in rho = lambda beta_b / beta_a the four upper extrinsic rows are
a / rho - b, the four lower ones c rho - d, and the three metric rows e - m rho^2. Their weighted sum of squares is
stationary where a polynomial of degree six vanishes; the positive root of least cost is the global minimum.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from factors.conformal_pair import COLUMNS, pair_kernel, pair_workspace
from factors.noise import ROWS, PairNoise
from factors.surface import PERSPECTIVE, Camera


@njit(cache=True)
def scale_kernel(data, ya, yb, kappa, precision, workspace, r, J):
    """log rho of one pair that minimises the whitened rows; NaN where no row depends on it."""
    pair_kernel(data, ya, yb, 0.0, kappa, workspace[0], workspace[1], r, J, True)
    # Cost A/rho^2 - 2B/rho + C rho^2 - 2D rho + E rho^4 - 2F rho^2, read off the rows and their slope at rho = 1.
    A = B = C = D = E = F = 0.0
    for k in range(2):
        for row in (9 * k + 2, 9 * k + 5):
            p = precision[row] ** 2
            a = -J[row, 12]
            A += p * a * a
            B += p * a * (a - r[row])
        for row in (9 * k + 6, 9 * k + 7):
            p = precision[row] ** 2
            c = J[row, 12]
            C += p * c * c
            D += p * c * (c - r[row])
    for row in range(18, 21):
        p = precision[row] ** 2
        m = -0.5 * J[row, 12]
        E += p * m * m
        F += p * m * (r[row] + m)
    if not (A > 0.0 or C > 0.0 or E > 0.0):
        return np.nan
    if not (A > 0.0 or C > 0.0):
        return 0.5 * np.log(F / E) if F > 0.0 else np.nan
    best, best_cost = np.nan, np.inf
    for root in np.roots(np.array([2.0 * E, 0.0, C - 2.0 * F, -D, 0.0, B, -A]) + 0.0j):
        rho = root.real
        if rho > 0.0 and abs(root.imag) < 1e-7 * abs(root):
            rho2 = rho * rho
            cost = A / rho2 - 2.0 * B / rho + (C - 2.0 * F) * rho2 - 2.0 * D * rho + E * rho2 * rho2
            if cost < best_cost:
                best, best_cost = rho, cost
    return np.log(best)


@njit(cache=True, parallel=True)
def _scales(data, weight, frame, edges, kappa, precision, log_rho):
    P, E = weight.shape
    for i in prange(P):
        workspace = pair_workspace()
        r, J = np.empty(ROWS), np.empty((ROWS, COLUMNS))
        for e in range(E):
            if weight[i, e] > 0.0:
                ya, yb = frame[i, edges[e, 0], :5], frame[i, edges[e, 1], :5]
                log_rho[i, e] = scale_kernel(data[i, e], ya, yb, kappa, precision, workspace, r, J)


def closed_form_log_rho(
    data: np.ndarray,
    weight: np.ndarray,
    frame: np.ndarray,
    edges: np.ndarray,
    noise: PairNoise,
    camera: Camera = PERSPECTIVE,
) -> np.ndarray:
    """log rho = log lambda + kappa (log beta_b - log beta_a) of every pair, shape (P, E); 0 where the weight is 0.

    Args:
        data: (P, E, 14) pair data.
        weight: (P, E), only whether it is positive matters.
        frame: (P, F, 6) variables of every point and image; the log depth is not used.
        edges: (E, 2).
        noise: sigmas of the blocks (its robust loss is not used).
        camera: camera model.
    """
    log_rho = np.zeros(weight.shape)
    _scales(data, weight, frame, np.asarray(edges), camera.kappa, noise.precisions(), log_rho)
    return log_rho
