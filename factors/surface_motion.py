"""Motion of a whole surface between views whose shapes are known: what ties the cameras once the map is eliminated.

View k knows N points x in its camera frame, in the reconstruction's unit; its camera's pose (R, t) and log scale g put
them at t + e^g R x in the world. With the coefficients c of `map_motion`, point by point,

    r = e^(-g_u) sum_k c_k (t_k + e^(g_k) R_k x_k),

g_u the scale of the view that gives the unit. The same residuals as those of `map_motion`, as functions of the cameras
alone: a pose graph of similarities. They are linear in the homogeneous points (x_1, ..., x_K, w), w = 1, so that the
triangle of a QR decomposition stands for any number of points without loss: 3 K + 1 points with other w.

Derivatives, for GTSAM's right perturbation (rotation, then translation) of the poses:

    dr = e^(-g_u) c_k (-e^(g_k) R_k [x_k]x d_omega + w R_k d_v + e^(g_k) R_k x_k dg_k) - r dg_u.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gtsam
import numpy as np
from numba import njit

from factors.adapter import make_factor
from factors.jacobian_check import Example
from factors.keys import CAMERA_POSE, VIEW_SCALE, key
from factors.map_motion import motion_coefficients, motion_variance


@njit(cache=True)
def surface_motion_kernel(R, t, g, c, x, w, r, J):
    """Residuals r (N, 3) and Jacobian J (N, 3, 7 K), both outputs, of N homogeneous points (x, w) of K views.

    Columns: pose (6) and log scale (1) of every view. R (K, 3, 3), t (K, 3), g (K,), c (K,), x (K, N, 3), w (N,).
    """
    K, N = x.shape[:2]
    u = (K - 1) // 2  # map_motion.scale_view
    unit = np.exp(-g[u])
    r[:] = 0.0
    for k in range(K):
        size = np.exp(g[k])
        for n in range(N):
            turned = R[k] @ x[k, n]
            for i in range(3):
                near, far = (i + 1) % 3, (i + 2) % 3
                r[n, i] += unit * c[k] * (w[n] * t[k, i] + size * turned[i])
                for j in range(3):
                    # The columns of -R [x]x are R (e_j x x) = R e_j x R x.
                    turn = R[k, near, j] * turned[far] - R[k, far, j] * turned[near]
                    J[n, i, 7 * k + j] = unit * c[k] * size * turn
                    J[n, i, 7 * k + 3 + j] = unit * c[k] * w[n] * R[k, i, j]
                J[n, i, 7 * k + 6] = unit * c[k] * size * turned[i]
    J[:, :, 7 * u + 6] -= r


class SurfaceMotion:
    """Three rows per point over (pose, log scale) of every view."""

    __slots__ = ("coefficients", "points", "rows", "weight")
    name = "surface motion"

    def __init__(self, coefficients: np.ndarray, points: np.ndarray, weight: np.ndarray):
        """Points x (K, N, 3) of K views and their last coordinates w (N,)."""
        self.coefficients, self.points, self.weight = coefficients, np.ascontiguousarray(points), weight.copy()
        self.rows = 3 * points.shape[1]

    def residual(self, *x: Any) -> np.ndarray:
        return self.jacobians(*x)[0]

    def jacobians(self, *x: Any) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        R = np.array([pose.rotation().matrix() for pose in x[::2]])
        t = np.array([pose.translation() for pose in x[::2]])
        g = np.array([scale[0] for scale in x[1::2]])
        r, J = np.empty((self.rows // 3, 3)), np.empty((self.rows // 3, 3, 7 * len(R)))
        surface_motion_kernel(R, t, g, self.coefficients, self.points, self.weight, r, J)
        J = J.reshape(self.rows, -1)
        return r.ravel(), [J[:, a:b] for k in range(len(R)) for a, b in ((7 * k, 7 * k + 6), (7 * k + 6, 7 * k + 7))]


def surface_motion_factor(views: Sequence[int], points: np.ndarray, sigma: float) -> gtsam.CustomFactor:
    """Smoothness in time of a surface that some views share.

    Args:
        views: two views: the surface moves little between them. Three: its points change their velocities little.
        points: (K, N, 3) the points they share in the camera frame of each, in the reconstruction's unit.
        sigma: as in `map_motion.map_motion_factor`.
    """
    K, N = points.shape[:2]
    homogeneous = np.concatenate([*points, np.ones((N, 1))], axis=1)
    if homogeneous.shape[1] < N:
        homogeneous = np.linalg.qr(homogeneous).R
    few = homogeneous[:, :-1].reshape(-1, K, 3).swapaxes(0, 1)
    measurement = SurfaceMotion(motion_coefficients(views), few, homogeneous[:, -1])
    noise = gtsam.noiseModel.Isotropic.Sigma(measurement.rows, sigma * float(motion_variance(views)) ** 0.5)
    keys = [k for view in views for k in (key(CAMERA_POSE, 0, view), key(VIEW_SCALE, 0, view))]
    readers = (gtsam.Values.atPose3, gtsam.Values.atVector) * K
    return make_factor(measurement, keys, (6, 1) * K, noise, readers=readers)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """Few and many points, two views and three, for the Jacobian check."""
    for label, views, n_points in (("motion", (2, 5), 4), ("many points", (2, 3), 30), ("velocity", (2, 3, 6), 20)):
        factor = surface_motion_factor(views, rng.normal(size=(len(views), n_points, 3)), 0.3)
        values = gtsam.Values()
        for k in factor.keys()[::2]:
            values.insert(k, gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3)))
        for k in factor.keys()[1::2]:
            values.insert(k, rng.normal(0.0, 0.3, 1))
        yield label, factor, values
