"""Anchor of a surface point in the world: the sight ray of a view, its depth and scale, against a map point.

A reconstruction without poses knows a point of view j as exp(b) (u, v, 1) in the camera frame, b its log depth in the
reconstruction's unit. With the camera's pose (R, t), camera to world, and the log scale g of the view (world unit per
unit of the reconstruction) it lies in the world at distance z = exp(g + b) along the optical axis. The residual is its
offset from the map point m, along the axes of the map frame and in units of that distance,

    r = (t + z R p - m) / z = R p + (t - m) / z,    p = (u, v, 1).

An error of the image point, in normalised coordinates, is an error of the same size of r, whatever the distance: one
isotropic noise model holds for all anchors. Along the ray r adds to the uncertainty of the depth, which is larger.

Derivatives, for GTSAM's right perturbation (rotation, then translation) of the pose:

    dr = -R [p]x d_omega + R d_v / z + (m - t) / z (dg + db) - dm / z.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np
from numba import njit

from factors.adapter import make_factor
from factors.jacobian_check import Example
from factors.keys import CAMERA_POSE, LOG_DEPTH, MAP_POINT, VIEW_SCALE, key

COLUMNS = 11
"""Pose (6), log scale of the view (1), log depth (1), map point (3)."""
POSE, SCALE, DEPTH, POINT = slice(0, 6), slice(6, 7), slice(7, 8), slice(8, 11)


@njit(cache=True)
def anchor_kernel(R, t, log_distance, image, m, r, J):
    """Residual r (3,) and Jacobian J (3, 11), both outputs, of one anchor at log z = g + b."""
    u, v = image[0], image[1]
    inverse = np.exp(-log_distance)
    for i in range(3):
        offset = inverse * (t[i] - m[i])
        r[i] = R[i, 0] * u + R[i, 1] * v + R[i, 2] + offset
        # The columns of -R [p]x are R (e_k x p).
        J[i, 0] = R[i, 2] * v - R[i, 1]
        J[i, 1] = R[i, 0] - R[i, 2] * u
        J[i, 2] = R[i, 1] * u - R[i, 0] * v
        J[i, 6] = J[i, 7] = -offset
        for k in range(3):
            J[i, 3 + k] = inverse * R[i, k]
            J[i, 8 + k] = -inverse if i == k else 0.0


@njit(cache=True)
def linearise_anchors(R, t, log_distance, image, m):
    """Residuals (N, 3) and Jacobians (N, 3, 11) of N anchors: R (N, 3, 3), t (N, 3), image (N, 2), m (N, 3)."""
    N = len(log_distance)
    r, J = np.empty((N, 3)), np.empty((N, 3, COLUMNS))
    for n in range(N):
        anchor_kernel(R[n], t[n], log_distance[n], image[n], m[n], r[n], J[n])
    return r, J


class CameraAnchor:
    """Three rows over (pose, g, b, m)."""

    __slots__ = ("image",)
    name = "camera anchor"
    rows = 3

    def __init__(self, image: np.ndarray):
        self.image = np.asarray(image, dtype=float)

    def residual(self, pose: gtsam.Pose3, g: np.ndarray, b: np.ndarray, m: np.ndarray) -> np.ndarray:
        return self.jacobians(pose, g, b, m)[0]

    def jacobians(
        self, pose: gtsam.Pose3, g: np.ndarray, b: np.ndarray, m: np.ndarray
    ) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        r, J = np.empty(3), np.empty((3, COLUMNS))
        anchor_kernel(pose.rotation().matrix(), pose.translation(), g[0] + b[0], self.image, m, r, J)
        return r, (J[:, POSE], J[:, SCALE], J[:, DEPTH], J[:, POINT])


READERS = (gtsam.Values.atPose3, gtsam.Values.atVector, gtsam.Values.atVector, gtsam.Values.atPoint3)


def camera_anchor_factor(
    point: int,
    view: int,
    image: np.ndarray,
    noise: gtsam.noiseModel.Base,
    map_view: int | None = None,
    pose_key: int | None = None,
    checked: bool = False,
) -> gtsam.CustomFactor:
    """Anchor of one point of one view to the map.

    Args:
        point, view: indices of the variables, camera pose, view scale and log depth.
        image: (2,) tracked point, normalised coordinates.
        noise: three-dimensional noise of the image point, normalised coordinates, robust or not.
        map_view: view of the map point; the same view unless given. Anchors of several views to one map point say that
            the point does not move between them.
        pose_key: key of the camera's pose (`gtsam.Pose3`, camera to world), where the graph has one of its own.
        checked: check shapes in every call.
    """
    keys = (
        key(CAMERA_POSE, 0, view) if pose_key is None else pose_key,
        key(VIEW_SCALE, 0, view),
        key(LOG_DEPTH, point, view),
        key(MAP_POINT, point, view if map_view is None else map_view),
    )
    return make_factor(CameraAnchor(image), keys, (6, 1, 1, 3), noise, readers=READERS, checked=checked)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """Anchors near to and far from the map point, for the Jacobian check."""
    for label, distance in (("near", 0.05), ("far", 2.0)):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
        image, g, b = rng.normal(0.0, 0.4, 2), rng.normal(0.0, 0.3, 1), rng.normal(0.0, 0.3, 1)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.2, 0.3, 0.4]))
        factor = camera_anchor_factor(4, 2, image, noise, checked=True)
        values = gtsam.Values()
        point = pose.transformFrom(np.exp(g[0] + b[0]) * np.array([*image, 1.0]))
        values.insert(factor.keys()[0], pose)
        for k, value in zip(factor.keys()[1:], (g, b, point + distance * rng.normal(size=3)), strict=True):
            values.insert(k, value)
        yield label, factor, values
