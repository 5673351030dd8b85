"""`diff`: non-rigid structure from motion from diffeomorphic mappings.

Parashar, Salzmann, Fua, "Local non-rigid structure-from-motion from diffeomorphic mappings", CVPR 2020. Surfaces need
be neither isometric nor conformal; the map between them is locally linear and carries the moving frame of one to that
of the other. From first derivatives of the warps alone, a pair (a, b) then satisfies, with K = J^-1 the Jacobian from b
to a and z = K^T y_a:

    (i)   level lines of depth correspond:         y_b = s z
    (ii)  so does what a tangent shares with them:  s det K |y_a|^2 (q_b . n_b) = (q_a . n_a) |z|^2 + n_a . K z
    (iii) and the images of the surface normals:   K w_b parallel to w_a,   w = q + y + q (q . y)

with n_a = (y_a2, -y_a1) and n_b = (z2, -z1) along the level lines. Inserting (i) and (ii) in (iii) leaves a polynomial
p of degree five in y_a without terms below degree three. In polar coordinates y_a = r (cos, sin), p / r^3 is a
quadratic in r; the sum of its squares over all pairs is minimised over |r| <= 1 and the angle.

Simplified: a search over polar coordinates instead of resultants, and the slopes of the other images by Christoffel
transfer, since (ii) divides by q_b . n_b, which vanishes. Published 3D error on the T-shirt: 4.02 %; 4.36 % from the
authors' public code; 4.52 % here.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.baselines.star import Star, reconstruct_star
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks

ANGLES = 180
"""Directions of the slope that are tried, over half a turn."""
RADII = np.linspace(-1.0, 1.0, 201)
"""Signed sizes of the slope that are tried in each direction."""


def reconstruct(tracks: Tracks, config: Config, progress: Progress) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct from a star of diffeomorphic mappings; the configuration is not used.

    Raises:
        ComputationError: no image is recovered.
    """
    return reconstruct_star(tracks, "diff", reference_slopes, progress)


def reference_slopes(star: Star) -> np.ndarray:
    """(P, 2) first-order terms of the reference, 0 for points without a pair."""
    angle = (np.arange(ANGLES) + 0.5) * np.pi / ANGLES
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slopes = np.zeros_like(star.image_a)
    for p in np.flatnonzero(np.logical_or.reduce(star.valid)):
        used = star.valid[:, p]
        K = np.linalg.inv(star.J[used, p])
        c0, c1, c2 = pair_quadratics(star.image_a[p], star.image_b[used, p], K, direction)
        cost = sum(
            np.multiply.outer((a * b).sum(axis=0), RADII ** (i + j))
            for i, a in enumerate((c0, c1, c2))
            for j, b in enumerate((c0, c1, c2))
        )
        best_angle, best_radius = np.unravel_index(np.argmin(cost), np.shape(cost))
        slopes[p] = RADII[best_radius] * direction[best_angle]
    return slopes


def pair_quadratics(
    q_a: np.ndarray, q_b: np.ndarray, K: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients (E, N) of p / r^3 = c0 + c1 r + c2 r^2 of E pairs in N directions.

    Args:
        q_a: (2,) point in the reference.
        q_b: (E, 2) in the other images.
        K: (E, 2, 2) Jacobians from image b to the reference.
        direction: (N, 2) unit directions of y_a.
    """
    z = np.einsum("eki,nk->eni", K, direction)
    n_a, n_b = _turned(direction), _turned(z)
    # s = (skew r^2 + reach r^3) / (across r^3): both sides of (ii) by powers of r.
    skew = np.einsum("ni,eij,enj->en", n_a, K, z)
    reach = (n_a @ q_a) * (z**2).sum(axis=-1)
    across = np.linalg.det(K)[:, None] * np.einsum("ei,eni->en", q_b, n_b)
    M_z = z + q_b[:, None] * np.einsum("ei,eni->en", q_b, z)[..., None]
    # w_b times across r^3, and w_a, by powers of r.
    w_b3 = np.einsum("eij,enj->eni", K, q_b[:, None] * across[..., None] + M_z * skew[..., None])
    w_b4 = np.einsum("eij,enj->eni", K, M_z * reach[..., None])
    w_a1 = direction + q_a * (direction @ q_a)[:, None]
    return _cross(w_b3, q_a), _cross(w_b4, q_a) + _cross(w_b3, w_a1), _cross(w_b4, w_a1)


def _turned(x: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], -x[..., 0]], axis=-1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
