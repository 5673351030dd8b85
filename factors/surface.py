"""Surface geometry at a pixel: moving frame, metric and connections of a depth surface (eqs. 3-8).

A surface seen by one camera is a function of the normalised image coordinates x = (u, v). Everything a pair factor
needs of it follows from the sight ray p and from the depth's derivatives divided by the depth:

    perspective   Phi = beta (u, v, 1),  y1 = beta_u / beta, ..., y22 = beta_vv / beta,  p = (u, v, 1), kappa = 1
    orthographic  Phi = (u, v, beta),    y1 = beta_u,        ..., y22 = beta_vv,         p = (0, 0, 1), kappa = 0

In both cases, with the perspective depth divided out,

    e1 = ex + y1 p,   e2 = ey + y2 p,   n = e1 x e2 = (-y1, -y2, w),   w = 1 + p_x y1 + p_y y2,
    e11 = y11 p + 2 kappa y1 ex,   e12 = y12 p + kappa (y1 ey + y2 ex),   e22 = y22 p + 2 kappa y2 ey.

Writing p in the frame (e1, e2, n), p = q1 e1 + q2 e2 + n / D with D = |n|^2, gives the connections in closed form:
Gamma_ij = m_ij (q1, q2, 1/D) + kappa (terms in y1, y2), where m_ij = y_ij - 2 kappa y_i y_j vanishes for a plane.

Frames and signs: camera frame x right, y down, z forward; the frame's third vector n points away from the camera, so
a surface normal towards the camera is -n / |n|. "Unit-depth frame" means E with the perspective depth divided out;
the true frame is E diag(beta, beta, beta^2) and the true connections are diag^-1 Gamma diag.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit


@dataclass(frozen=True)
class Camera:
    """How a pixel sees: `kappa` is 1 where depth scales the image (perspective), 0 where it does not (orthographic)."""

    name: str
    kappa: float

    def rays(self, image: np.ndarray) -> np.ndarray:
        """First two components (p_x, p_y) of the sight rays of normalised image points, shape (..., 2)."""
        return self.kappa * np.asarray(image, dtype=float)

    def points(self, image: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Surface points in the camera frame, shape (..., 3)."""
        image = np.asarray(image, dtype=float)
        depth = np.asarray(depth, dtype=float)[..., None]
        if self.kappa:
            return np.concatenate([image * depth, depth], axis=-1)
        return np.concatenate([np.broadcast_to(image, (*depth.shape[:-1], 2)), depth], axis=-1)

    def image(self, points: np.ndarray) -> np.ndarray:
        """Normalised image coordinates (..., 2) of surface points in the camera frame."""
        points = np.asarray(points, dtype=float)
        return points[..., :2] / points[..., 2:] if self.kappa else points[..., :2].copy()


PERSPECTIVE = Camera("perspective", 1.0)
ORTHOGRAPHIC = Camera("orthographic", 0.0)
CAMERAS = {camera.name: camera for camera in (PERSPECTIVE, ORTHOGRAPHIC)}


@njit(cache=True, inline="always")
def metric_kernel(px, py, y1, y2):
    """(g11, g12, g22) of the unit-depth frame."""
    s = px * px + py * py + 1.0
    return 1.0 + y1 * (2.0 * px + y1 * s), y1 * py + y2 * px + y1 * y2 * s, 1.0 + y2 * (2.0 * py + y2 * s)


@njit(cache=True, inline="always")
def metric_derivatives(px, py, y1, y2):
    """(dg11/dy1, dg12/dy1, dg12/dy2, dg22/dy2); the other two vanish."""
    s = px * px + py * py + 1.0
    return 2.0 * (px + y1 * s), py + y2 * s, px + y1 * s, 2.0 * (py + y2 * s)


@njit(cache=True)
def connection_kernel(px, py, kappa, y, G, dG, derivatives):
    """Connections of the unit-depth frame and their derivatives.

    Args:
        px, py, kappa: the camera's view of the pixel.
        y: (y1, y2, y11, y12, y22).
        G: output (2, 3, 3); G[k] = E^-1 dE/dx_k, column j holds the coefficients of d e_j (eq. 7).
        dG: output (2, 3, 3, 5), derivatives with respect to y; untouched unless `derivatives`.
        derivatives: whether dG is wanted.
    """
    y1, y2 = y[0], y[1]
    w = 1.0 + px * y1 + py * y2
    D = y1 * y1 + y2 * y2 + w * w
    q = ((y1 + px * w) / D, (y2 + py * w) / D, 1.0 / D)
    g11, g12, g22 = metric_kernel(px, py, y1, y2)
    # Deviations from a plane, and the (i, j) they belong to.
    m = (y[2] - 2.0 * kappa * y1 * y1, y[3] - 2.0 * kappa * y1 * y2, y[4] - 2.0 * kappa * y2 * y2)
    # Tangential columns: G[k][:, j] = Gamma_{kj}, symmetric in (k, j).
    for r in range(3):
        G[0, r, 0] = m[0] * q[r]
        G[0, r, 1] = m[1] * q[r]
        G[1, r, 1] = m[2] * q[r]
    G[0, 0, 0] += 2.0 * kappa * y1
    G[0, 0, 1] += kappa * y2
    G[0, 1, 1] += kappa * y1
    G[1, 1, 1] += 2.0 * kappa * y2
    for r in range(3):
        G[1, r, 0] = G[0, r, 1]
    # Normal column: d n = h_{k1} (-g22 e1 + g12 e2) + h_{k2} (g12 e1 - g11 e2) + trace n (Weingarten).
    for k in range(2):
        h1, h2 = G[k, 2, 0], G[k, 2, 1]
        G[k, 0, 2] = g12 * h2 - g22 * h1
        G[k, 1, 2] = g12 * h1 - g11 * h2
        G[k, 2, 2] = G[k, 0, 0] + G[k, 1, 1]
    if not derivatives:
        return
    # dq_r / dy_c for c = 1, 2, from dD/dy_c = 2 D q_c.
    dq = (
        ((1.0 + px * px) / D - 2.0 * q[0] * q[0], px * py / D - 2.0 * q[0] * q[1]),
        (px * py / D - 2.0 * q[1] * q[0], (1.0 + py * py) / D - 2.0 * q[1] * q[1]),
        (-2.0 * q[2] * q[0], -2.0 * q[2] * q[1]),
    )
    dm = ((-4.0 * kappa * y1, 0.0), (-2.0 * kappa * y2, -2.0 * kappa * y1), (0.0, -4.0 * kappa * y2))
    for r in range(3):
        for c in range(2):
            dG[0, r, 0, c] = m[0] * dq[r][c] + dm[0][c] * q[r]
            dG[0, r, 1, c] = m[1] * dq[r][c] + dm[1][c] * q[r]
            dG[1, r, 1, c] = m[2] * dq[r][c] + dm[2][c] * q[r]
        for c in range(3):
            dG[0, r, 0, 2 + c] = q[r] if c == 0 else 0.0
            dG[0, r, 1, 2 + c] = q[r] if c == 1 else 0.0
            dG[1, r, 1, 2 + c] = q[r] if c == 2 else 0.0
    dG[0, 0, 0, 0] += 2.0 * kappa
    dG[0, 0, 1, 1] += kappa
    dG[0, 1, 1, 0] += kappa
    dG[1, 1, 1, 1] += 2.0 * kappa
    for r in range(3):
        for c in range(5):
            dG[1, r, 0, c] = dG[0, r, 1, c]
    d11, d12_1, d12_2, d22 = metric_derivatives(px, py, y1, y2)
    for k in range(2):
        h1, h2 = G[k, 2, 0], G[k, 2, 1]
        for c in range(5):
            t1, t2 = dG[k, 2, 0, c], dG[k, 2, 1, c]
            dG[k, 0, 2, c] = g12 * t2 - g22 * t1
            dG[k, 1, 2, c] = g12 * t1 - g11 * t2
            dG[k, 2, 2, c] = dG[k, 0, 0, c] + dG[k, 1, 1, c]
        dG[k, 0, 2, 0] += d12_1 * h2
        dG[k, 0, 2, 1] += d12_2 * h2 - d22 * h1
        dG[k, 1, 2, 0] += d12_1 * h1 - d11 * h2
        dG[k, 1, 2, 1] += d12_2 * h1


@njit(cache=True)
def _connections(rays, kappa, y, G, dG):
    for n in range(rays.shape[0]):
        connection_kernel(rays[n, 0], rays[n, 1], kappa, y[n], G[n], dG, False)


def moving_frame(
    image: np.ndarray, first_order: np.ndarray, depth: np.ndarray | float = 1.0, camera: Camera = PERSPECTIVE
) -> np.ndarray:
    """Moving frame E = (e1, e2, e3) as columns, shape (..., 3, 3) (eq. 4).

    Args:
        image: (..., 2) normalised image coordinates.
        first_order: (..., 2), y1 and y2.
        depth: (...) depth beta; 1 gives the unit-depth frame. An orthographic frame does not depend on it.
        camera: camera model.
    """
    rays = camera.rays(image)
    p = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
    y = np.asarray(first_order, dtype=float)
    e1 = y[..., :1] * p + np.array([1.0, 0.0, 0.0])
    e2 = y[..., 1:] * p + np.array([0.0, 1.0, 0.0])
    scale = np.asarray(depth, dtype=float)[..., None] ** camera.kappa
    e1, e2 = e1 * scale, e2 * scale
    return np.stack([e1, e2, np.cross(e1, e2)], axis=-1)


def metric(
    image: np.ndarray, first_order: np.ndarray, depth: np.ndarray | float = 1.0, camera: Camera = PERSPECTIVE
) -> np.ndarray:
    """First fundamental form g = (e1 e2)^T (e1 e2), shape (..., 2, 2) (eq. 5)."""
    tangents = moving_frame(image, first_order, depth, camera)[..., :2]
    return np.swapaxes(tangents, -1, -2) @ tangents


def normals(image: np.ndarray, first_order: np.ndarray, camera: Camera = PERSPECTIVE) -> np.ndarray:
    """Unit normals towards the camera, shape (..., 3)."""
    n = -moving_frame(image, first_order, camera=camera)[..., 2]
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def first_order_from_normals(image: np.ndarray, normal: np.ndarray, camera: Camera = PERSPECTIVE) -> np.ndarray:
    """First-order terms (..., 2) of a surface with the given normals: the inverse of `normals`.

    A normal n is orthogonal to e_k = e_k0 + y_k p, so y_k = -n_k / (n . p). Grazing normals give large values.
    """
    rays = camera.rays(image)
    normal = np.asarray(normal, dtype=float)
    along = normal[..., 0] * rays[..., 0] + normal[..., 1] * rays[..., 1] + normal[..., 2]
    return -normal[..., :2] / along[..., None]


def connections(
    image: np.ndarray, first_order: np.ndarray, second_order: np.ndarray, camera: Camera = PERSPECTIVE
) -> np.ndarray:
    """Connections of the unit-depth frame, shape (..., 2, 3, 3): Gamma_k = E^-1 dE/dx_k (eqs. 6-8).

    Args:
        image: (..., 2) normalised image coordinates.
        first_order: (..., 2).
        second_order: (..., 3), y11, y12, y22.
        camera: camera model.
    """
    rays = np.ascontiguousarray(camera.rays(image).reshape(-1, 2))
    y = np.concatenate([first_order, second_order], axis=-1).astype(float).reshape(-1, 5)
    G = np.empty((len(y), 2, 3, 3))
    _connections(rays, camera.kappa, y, G, np.empty((2, 3, 3, 5)))
    return G.reshape(*np.shape(image)[:-1], 2, 3, 3)


def planar_second_order(first_order: np.ndarray, camera: Camera = PERSPECTIVE) -> np.ndarray:
    """Second-order terms of the tangent plane (infinitesimal planarity), shape (..., 3).

    A plane is linear in 1/beta, hence y_ij = 2 y_i y_j in perspective and 0 in orthographic projection.
    """
    y1, y2 = np.moveaxis(np.asarray(first_order, dtype=float), -1, 0)
    return 2.0 * camera.kappa * np.stack([y1 * y1, y1 * y2, y2 * y2], axis=-1)
