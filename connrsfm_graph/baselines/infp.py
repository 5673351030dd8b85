"""`infp`: isometric non-rigid structure from motion by infinitesimal planarity.

Parashar, Pizarro, Bartoli, "Isometric non-rigid shape-from-motion with Riemannian geometry solved in linear time",
TPAMI 2018. Surfaces are isometric and locally planar. Then the first-order terms of image b follow from those of the
reference a by Christoffel transfer, y_b = J^-T (y_a - t), and the metric up to scale leaves two equations per pair in
the two unknowns of the reference,

    g11 M22 - M11 g22 = 0,   g12 M22 - M12 g22 = 0,   g = g_a(y_a), M = J^T g_b(y_b) J,

whose terms of degree four cancel: cubics. The sum of their squares over all pairs is a polynomial of degree six, of
which the global minimum is taken.

As published, but for the minimisation (a resultant instead of semidefinite relaxations). Published 3D error on the
T-shirt: 2.49 %; here 2.55 %.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.baselines.polynomial import affine, global_minimum, product
from connrsfm_graph.baselines.star import Star, reconstruct_star
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks


def reconstruct(tracks: Tracks, config: Config, progress: Progress) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct by infinitesimal planarity from a star of warps; the configuration is not used.

    Raises:
        ComputationError: no image is recovered.
    """
    return reconstruct_star(tracks, "infp", reference_slopes, progress)


def reference_slopes(star: Star) -> np.ndarray:
    """(P, 2) first-order terms of the reference, 0 for points without a pair."""
    first, second = metric_cubics(star)
    squares = (product(first, first) + product(second, second)) * star.valid[..., None, None]
    cost = squares.sum(axis=0)
    known = np.logical_or.reduce(star.valid)
    return np.array([global_minimum(p) if seen else np.zeros(2) for p, seen in zip(cost, known, strict=True)])


def metric_cubics(star: Star) -> tuple[np.ndarray, np.ndarray]:
    """Both equations of every pair (E, P, 4, 4) as polynomials in the reference's y1, y2."""
    q_a, q_b, J = star.image_a, star.image_b, star.J
    y_a = [affine(np.zeros(len(q_a)), 1.0, 0.0), affine(np.zeros(len(q_a)), 0.0, 1.0)]
    pulled = [affine(-star.t[..., 0], 1.0, 0.0), affine(-star.t[..., 1], 0.0, 1.0)]  # J^T y_b
    eye = np.broadcast_to(np.eye(2), (len(q_a), 2, 2))
    g = _metric(eye, q_a, (q_a**2).sum(axis=-1) + 1.0, y_a)
    # J^T (I + q y^T + y q^T + (|q|^2 + 1) y y^T) J has the form of g with J^T J for I and J^T q for q.
    through = np.einsum("epki,epkj->epij", J, J), np.einsum("epki,epk->epi", J, q_b)
    M = _metric(*through, (q_b**2).sum(axis=-1) + 1.0, pulled)
    equations = (product(g[0], M[2]) - product(M[0], g[2]), product(g[1], M[2]) - product(M[1], g[2]))
    return equations[0][..., :4, :4], equations[1][..., :4, :4]


def _metric(constant: np.ndarray, q: np.ndarray, square: np.ndarray, y: list[np.ndarray]) -> list[np.ndarray]:
    """Entries 11, 12, 22 of C + q y^T + y q^T + s y y^T as polynomials (..., 3, 3) for affine y1, y2."""
    entries = []
    for i, j in ((0, 0), (0, 1), (1, 1)):
        entry = square[..., None, None] * product(y[i], y[j])
        entry[..., :2, :2] += q[..., i, None, None] * y[j] + q[..., j, None, None] * y[i]
        entry[..., 0, 0] += constant[..., i, j]
        entries.append(entry)
    return entries
