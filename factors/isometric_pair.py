"""The pre-step's pair factor: four rows in the first-order terms alone (isometry, infinitesimal planarity).

Under an isometry and locally planar surfaces the Christoffel symbols transform by the warp's second derivatives
alone, which leaves two linear rows (Parashar, Pizarro, Bartoli, TPAMI 2018); the metric up to scale leaves two more:

    kappa (y_a - J^T y_b) - 1/3 grad log det J
    g11 M22 - M11 g22,   g12 M22 - M12 g22     with g = g_a and M = J^T g_b J of the unit-depth frames.

Depth and scale do not occur.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from numba import njit

from factors import keys
from factors.adapter import make_factor
from factors.surface import PERSPECTIVE, Camera, metric_derivatives, metric_kernel
from factors.warp_jet import PAIR_DATA_SIZE

ISOMETRIC_ROWS = 4


@njit(cache=True)
def isometric_kernel(data, ya, yb, kappa, r, J):
    """Residual (4,) and Jacobian (4, 4) with columns y1, y2 of image a, y1, y2 of image b; data as in `warp_jet`."""
    ua, va, ub, vb = kappa * data[0], kappa * data[1], kappa * data[2], kappa * data[3]
    j11, j12, j21, j22 = data[4], data[5], data[6], data[7]
    det = j11 * j22 - j12 * j21
    for k in range(2):
        h11, h12, h21, h22 = data[8 + k], data[9 + k], data[11 + k], data[12 + k]
        ddet = h11 * j22 + j11 * h22 - h12 * j21 - j12 * h21
        t1, t2 = (j11, j21) if k == 0 else (j12, j22)
        r[k] = kappa * (ya[k] - t1 * yb[0] - t2 * yb[1]) - ddet / (3.0 * det)
        J[k, 0] = kappa if k == 0 else 0.0
        J[k, 1] = kappa if k == 1 else 0.0
        J[k, 2] = -kappa * t1
        J[k, 3] = -kappa * t2
    g11, g12, g22 = metric_kernel(ua, va, ya[0], ya[1])
    b11, b12, b22 = metric_kernel(ub, vb, yb[0], yb[1])
    m11 = j11 * j11 * b11 + 2.0 * j11 * j21 * b12 + j21 * j21 * b22
    m12 = j11 * j12 * b11 + (j11 * j22 + j21 * j12) * b12 + j21 * j22 * b22
    m22 = j12 * j12 * b11 + 2.0 * j12 * j22 * b12 + j22 * j22 * b22
    r[2] = g11 * m22 - m11 * g22
    r[3] = g12 * m22 - m12 * g22
    d11, d12_1, d12_2, d22 = metric_derivatives(ua, va, ya[0], ya[1])
    J[2, 0] = d11 * m22
    J[2, 1] = -m11 * d22
    J[3, 0] = d12_1 * m22
    J[3, 1] = d12_2 * m22 - m12 * d22
    d11, d12_1, d12_2, d22 = metric_derivatives(ub, vb, yb[0], yb[1])
    m11_1, m11_2 = j11 * j11 * d11 + 2.0 * j11 * j21 * d12_1, j21 * j21 * d22 + 2.0 * j11 * j21 * d12_2
    m12_1 = j11 * j12 * d11 + (j11 * j22 + j21 * j12) * d12_1
    m12_2 = j21 * j22 * d22 + (j11 * j22 + j21 * j12) * d12_2
    m22_1, m22_2 = j12 * j12 * d11 + 2.0 * j12 * j22 * d12_1, j22 * j22 * d22 + 2.0 * j12 * j22 * d12_2
    J[2, 2], J[2, 3] = g11 * m22_1 - m11_1 * g22, g11 * m22_2 - m11_2 * g22
    J[3, 2], J[3, 3] = g12 * m22_1 - m12_1 * g22, g12 * m22_2 - m12_2 * g22


class IsometricPair:
    """The measurement of one pair; variables are y1, y2 of image a and of image b."""

    __slots__ = ("data", "kappa", "name", "rows")

    def __init__(self, data: np.ndarray, camera: Camera = PERSPECTIVE):
        self.name = "isometric pair"
        self.rows = ISOMETRIC_ROWS
        self.data = np.ascontiguousarray(data, dtype=float)
        self.kappa = camera.kappa

    def residual(self, ya: np.ndarray, yb: np.ndarray) -> np.ndarray:
        return self.jacobians(ya, yb)[0]

    def jacobians(self, ya: np.ndarray, yb: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        r, J = np.empty(ISOMETRIC_ROWS), np.empty((ISOMETRIC_ROWS, 4))
        isometric_kernel(self.data, ya, yb, self.kappa, r, J)
        return r, [J[:, :2], J[:, 2:]]


def isometric_pair_factor(
    point: int,
    views: tuple[int, int],
    data: np.ndarray,
    noise: gtsam.noiseModel.Base | None = None,
    camera: Camera = PERSPECTIVE,
) -> gtsam.CustomFactor:
    """The pre-step's factor of one point between images `views` = (a, b); `data` is (14,) pair data.

    Raises:
        FactorError: the data do not give finite rows, or the noise model's dimension is not 4.
    """
    measurement = IsometricPair(data, camera)
    return make_factor(
        measurement,
        [keys.key(keys.FIRST_ORDER, point, view) for view in views],
        [2, 2],
        gtsam.noiseModel.Unit.Create(ISOMETRIC_ROWS) if noise is None else noise,
        example=(np.zeros(2), np.zeros(2)),
    )


def examples(rng: np.random.Generator) -> Iterator[tuple[str, gtsam.NonlinearFactor, gtsam.Values]]:
    """Both cameras at random data (see `factors.jacobian_check`)."""
    from factors.surface import CAMERAS

    for camera in CAMERAS.values():
        data = rng.normal(scale=0.3, size=PAIR_DATA_SIZE) + np.array([0] * 4 + [1, 0, 0, 1] + [0] * 6)
        factor = isometric_pair_factor(3, (0, 1), data, camera=camera)
        values = gtsam.Values()
        for key in factor.keys():
            values.insert(key, rng.normal(scale=0.4, size=2))
        yield camera.name, factor, values
