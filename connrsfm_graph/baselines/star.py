"""What the local baselines `infp` and `diff` share: a star of warps around one image, and surfaces from slopes.

The reference is the image that sees most points. Both methods find the first-order terms y of a point in the reference
from its warps to all other images; under infinitesimal planarity those follow by Christoffel transfer,

    y_b = J^-T (y_a - t),   t = 1/3 grad log det J.

Settings are the publications' as far as they are general: Schwarzian warps and an integration with bending weight 1,
nothing robust. The warps' weight, tuned for each data set there, is the one that predicts left-out points best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from connrsfm_graph.baselines.outcome import MIN_POINTS, outcome
from connrsfm_graph.config import as_dict
from connrsfm_graph.integrate import IntegrationConfig, integrate
from connrsfm_graph.problem import Problem, flat_state
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.warps import WarpConfig, Warps, fit_warps
from factors.warp_jet import PAIR_DATA_SIZE

WARPS = WarpConfig(model="schwarzian", schwarzian=None, robust=False, covariance=False)
INTEGRATION = IntegrationConfig(bending=1.0, huber=np.inf)


@dataclass(frozen=True)
class Star:
    """Warps from the reference image a to the E other images b at P points."""

    image_a: np.ndarray
    """(P, 2) normalised coordinates in the reference."""
    image_b: np.ndarray
    """(E, P, 2) in the other images."""
    J: np.ndarray
    """(E, P, 2, 2) Jacobians, invertible everywhere."""
    t: np.ndarray
    """(E, P, 2) 1/3 grad log det J."""
    valid: np.ndarray
    """(E, P) bool, the pair may be used; its numbers are harmless where not."""

    @staticmethod
    def of(image: np.ndarray, warps: Warps) -> Star:
        """The star of image points (F, P, 2) whose edges (a, b) all have the same a."""
        seen = warps.valid[..., None]
        J = np.where(seen[..., None], warps.jets.jacobian, np.eye(2))
        hessian = np.where(seen[..., None], warps.jets.hessian, 0.0)
        dJ = np.stack([hessian[..., 0:2], hessian[..., 1:3]], axis=-3)  # by u and by v
        t = np.einsum("epij,epkji->epk", np.linalg.inv(J), dJ) / 3.0
        a, b = warps.edges.T
        seen_a = np.logical_or.reduce(warps.valid)[:, None]
        return Star(np.where(seen_a, image[a[0]], 0.0), np.where(seen, image[b], 0.0), J, t, warps.valid)


def reconstruct_star(
    tracks: Tracks, method: str, reference_slopes: Callable[[Star], np.ndarray], progress: Progress
) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct from the first-order terms (P, 2) that `reference_slopes` finds in the reference.

    Points the reference does not see are interpolated by the surfaces; images that share too few with it are not
    recovered.

    Raises:
        ComputationError: no image is recovered.
    """
    image, visible = tracks.normalised(), tracks.visible
    reference = int(visible.sum(axis=1).argmax())
    others = np.delete(np.arange(tracks.n_frames), reference)
    with progress.stage("warps"):
        edges = np.stack([np.full_like(others, reference), others], axis=-1)
        warps = fit_warps(image, visible, edges, WARPS, progress.update)
    star = Star.of(image, warps)
    with progress.stage("slopes"):
        y_a = reference_slopes(star)
        y_b = np.einsum("epji,epj->epi", np.linalg.inv(star.J), y_a - star.t)
    slopes = np.insert(y_b, reference, y_a, axis=0)
    found = np.insert(star.valid, reference, np.logical_or.reduce(star.valid), axis=0)
    with progress.stage("integration"):
        log_depth = _integrated(image, visible, slopes, found)
    settings = {"reference": reference, "warps": as_dict(WARPS), "integrate": as_dict(INTEGRATION)}
    decisions = {"warp weight": warps.config.schwarzian, "scale convention": "each image has mean log depth 0"}
    return outcome(tracks, log_depth, method, settings, decisions, progress, interpolated=~found)


def _integrated(image: np.ndarray, visible: np.ndarray, slopes: np.ndarray, found: np.ndarray) -> np.ndarray:
    """(F, P) log depth of the visible points from slopes (F, P, 2) known where `found`; NaN in images with too few."""
    log_depth = np.full(visible.shape, np.nan)
    frames = found.sum(axis=1) >= MIN_POINTS
    if frames.any():
        image, visible, slopes, found = image[frames], visible[frames], slopes[frames], found[frames]
        # Every image is integrated on its own: an edge to itself marks the points whose slopes are known.
        edges = np.repeat(np.arange(len(image))[:, None], 2, axis=1)
        shape = (visible.shape[1], len(edges))
        problem = Problem(
            image=np.where(visible[..., None], image, 0.0).transpose(1, 0, 2),
            visible=visible.T,
            edges=edges,
            data=np.zeros((*shape, PAIR_DATA_SIZE)),
            weight=found.T.astype(float),
        )
        state = flat_state(problem).updated(first_order=np.where(found[..., None], slopes, 0.0).transpose(1, 0, 2))
        log_depth[frames] = np.where(visible, integrate(problem, state, INTEGRATION).log_depth.T, np.nan)
    return log_depth
