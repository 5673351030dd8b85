"""Agreement of warps around cycles of the image graph: a check that needs no truth.

The warps of a triangle of images a < b < c must compose: eta_ac = eta_bc after eta_ab, so that at every point seen in
all three J_ac = J_bc J_ab. Values agree by construction at the tracked points, Jacobians do not, and they are what the
pair factors use. A warp that disagrees around most of its triangles is suspect.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.warps.fit import Warps


@dataclass(frozen=True)
class CycleAgreement:
    """Disagreement of Jacobians around the triangles of the image graph."""

    triangles: np.ndarray
    """(T, 3) indices of the edges ab, bc and ac of each triangle."""
    disagreement: np.ndarray
    """(T,) median over points of |J_bc J_ab - J_ac| / |J_ac| (Frobenius); NaN where no point is shared."""
    edge: np.ndarray
    """(E,) median over the triangles of each edge; NaN for an edge without any."""

    def suspects(self, factor: float = 5.0, least: float = 0.1) -> np.ndarray:
        """Indices of edges whose disagreement exceeds `least` and `factor` times the median over all edges."""
        known = self.edge[np.isfinite(self.edge)]
        if not len(known):
            return np.empty(0, dtype=int)
        return np.flatnonzero(self.edge > max(least, factor * np.median(known)))


def cycle_agreement(warps: Warps) -> CycleAgreement:
    """Compare the warps around every triangle of the image graph, whose edges must run from lower to higher images."""
    index = {(int(a), int(b)): e for e, (a, b) in enumerate(warps.edges)}
    after: dict[int, list[int]] = {}
    for a, b in index:
        after.setdefault(a, []).append(b)
    triangles = np.array(
        [(index[a, b], index[b, c], index[a, c]) for a, b in index for c in after.get(b, ()) if (a, c) in index],
        dtype=int,
    ).reshape(-1, 3)
    J = warps.jets.jacobian
    disagreement = np.full(len(triangles), np.nan)
    for t, (ab, bc, ac) in enumerate(triangles):
        shared = warps.valid[ab] & warps.valid[bc] & warps.valid[ac]
        if shared.any():
            gap = np.linalg.norm(J[bc, shared] @ J[ab, shared] - J[ac, shared], axis=(1, 2))
            disagreement[t] = np.median(gap / np.linalg.norm(J[ac, shared], axis=(1, 2)))
    edge = np.full(len(warps.edges), np.nan)
    known = np.isfinite(disagreement)
    for e in np.unique(triangles[known]):
        edge[e] = np.median(disagreement[known & (triangles == e).any(axis=1)])
    return CycleAgreement(triangles, disagreement, edge)
