"""The images of a long sequence that are no keyframes: each follows the keyframe that looks most like it.

A block of images needs the keyframes' surfaces and nothing of the other blocks, so that blocks can be worked on in any
order, one after the other or many at once, with the same result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.keyframes import nearest_keyframe
from connrsfm_graph.problem import make_problem
from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.refine.follow import Reference, follow
from connrsfm_graph.surfaces import Surfaces, scales, surfaces_of_points
from connrsfm_graph.warps import WarpConfig, fit_warps
from factors.surface import Camera


@dataclass(frozen=True)
class Guide:
    """What the other images need of K keyframes."""

    image: np.ndarray
    """(K, P, 2) normalised coordinates."""
    visible: np.ndarray
    """(K, P) bool."""
    surfaces: Surfaces
    """Their surfaces."""
    reference: Reference
    """The refinement's fit."""
    bending: float
    """Bending weight of the splines that give the surfaces' terms."""
    warps: WarpConfig
    """With model and weights as chosen for the keyframes."""
    refine: RefineConfig
    """Settings of the refinement."""
    min_shared: int
    """Tracks that an image must share with its keyframe."""
    camera: Camera
    """Camera model."""


@dataclass(frozen=True)
class Others:
    """B images that follow keyframes."""

    surfaces: Surfaces
    """Their surfaces, in the scale of the keyframes."""
    keyframe: np.ndarray
    """(B,) index of the keyframe that each follows, the other end of its edge in the image graph."""
    edge_weight: np.ndarray
    """(B,) tracks that the two share."""
    conformal_scale: np.ndarray
    """(B, P) from the keyframe to the image, NaN where the pair was not observed."""
    problem: tuple[str | None, ...]
    """What is wrong with the warp of each edge."""


def reconstruct_others(guide: Guide, image: np.ndarray, visible: np.ndarray) -> Others:
    """Surfaces of further images.

    Args:
        guide: the keyframes.
        image: (B, P, 2) normalised coordinates.
        visible: (B, P) bool.
    """
    K, B = len(guide.image), len(image)
    nearest = nearest_keyframe(image, visible, guide.image, guide.visible, guide.min_shared)
    edges = np.stack([nearest, K + np.arange(B)], axis=1)
    all_images, all_visible = np.concatenate([guide.image, image]), np.concatenate([guide.visible, visible])
    warps = fit_warps(all_images, all_visible, edges, guide.warps)
    pairs = make_problem(all_images, all_visible, edges, warps.jets, warps.weight * warps.valid, guide.camera)
    found = follow(guide.reference, image, visible, nearest, guide.refine)
    constrained = pairs.constrained().T[K:] & visible
    surfaces, _ = surfaces_of_points(found, constrained, guide.camera, guide.bending)
    frame = np.concatenate([guide.surfaces.frame(), surfaces.frame()], axis=1)
    log_factor = np.concatenate([guide.surfaces.log_factor, surfaces.log_factor])
    return Others(
        surfaces=surfaces,
        keyframe=nearest,
        edge_weight=(guide.visible[nearest] & visible).sum(axis=1).astype(float),
        conformal_scale=scales(pairs, frame, log_factor),
        problem=tuple(report.problem for report in warps.reports),
    )
