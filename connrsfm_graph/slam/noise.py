"""Noise levels of the factors that tie a reconstruction to the world, found without any truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.slam.sightings import Sightings
from connrsfm_graph.warps.noise import estimate_pixel_noise

_FEWEST = 4
"""Shared points from which two views can be fitted onto each other with something left to see the noise by."""
_USUAL = 1e-3
"""Noise of image points where the views are too few or too sparse to show it."""
_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class FusionNoise:
    """Noise levels of the factors that tie a reconstruction to the world."""

    image: float
    """Standard deviation of a coordinate of the image points, normalised coordinates."""
    depth: float
    """Standard deviation of the log depths where the reconstruction does not state its own."""
    motion: float
    """Standard deviation of a coordinate of a point's motion (or change of velocity) between neighbouring views, in
    the reconstruction's unit of depth."""
    scale: float
    """Standard deviation of the change of log scale between neighbouring views."""

    def __post_init__(self) -> None:
        for name in ("image", "depth", "motion", "scale"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"fusion: {name} noise is {getattr(self, name)}, expected a positive number")


def estimate_noise(reconstruction: Reconstruction | Sightings, image_sigma: float | None = None) -> FusionNoise:
    """Noise levels from the fit of neighbouring views onto each other, without any truth.

    Each view is fitted to the next by a similarity. What remains across the sight rays is motion; what remains along
    them beyond that is noise of the two depths, where these do not state their own. Depths that do come from all views
    together, neighbours share their errors, and what remains along the rays is motion too. The scales of the
    similarities are the drift of the unit. Medians over all points, so that a minority of wrong tracks does not matter.

    Args:
        reconstruction: two views or more.
        image_sigma: noise of the image points, normalised coordinates; where None it is estimated from image warps of
            the tracks, or of the sight rays where there are no tracks: those of a refined reconstruction are corrected
            and look better than they are.

    Raises:
        InputError: no two neighbouring views share enough points.
    """
    sightings = reconstruction if isinstance(reconstruction, Sightings) else Sightings.of(reconstruction)
    if image_sigma is None:
        image = reconstruction.image if isinstance(reconstruction, Sightings) else _tracked(reconstruction)
        image_sigma = image_noise(image, sightings.seen)
    points = sightings.points()
    across, along, scales, depths = [], [], [], []
    for a in range(sightings.n_views - 1):
        shared = sightings.seen[a] & sightings.seen[a + 1]
        if shared.sum() < _FEWEST:
            continue
        source, target = points[a, shared], points[a + 1, shared]
        scale, R, t = align_similarity(source, target)
        difference = target - (scale * source @ R.T + t)
        ray = target / np.linalg.norm(target, axis=1, keepdims=True)
        radial = (difference * ray).sum(axis=1)
        along.append(radial)
        across.append(np.linalg.norm(difference - radial[:, None] * ray, axis=1))
        scales.append(np.log(scale))
        depths.append(np.linalg.norm(target, axis=1))
    if not along:
        raise InputError(f"fusion: no two neighbouring views share {_FEWEST} points; state the noise levels")
    # The length of a normal vector in the plane has median 1.1774 sigma.
    motion = float(np.median(np.concatenate(across))) / 1.1774
    distance = float(np.median(np.concatenate(depths)))
    radial_std = _MAD * float(np.median(np.abs(np.concatenate(along))))
    floor = 0.1 * image_sigma
    stated = sightings.depth_std[sightings.seen]
    if np.isfinite(stated).mean() > 0.5:
        depth = float(np.nanmedian(stated))
        motion = float(np.sqrt((2.0 * motion**2 + radial_std**2) / 3.0))
    else:
        depth = float(np.sqrt(max(radial_std**2 - motion**2, 0.0) / 2.0)) / distance
    return FusionNoise(
        image=max(image_sigma, 1e-6),
        depth=max(depth, floor),
        motion=max(motion, floor * distance),
        scale=max(_MAD * float(np.median(np.abs(scales))), 1e-3),
    )


def image_noise(image: np.ndarray, seen: np.ndarray) -> float:
    """Standard deviation of a coordinate of image points (F, P, 2) by the warps between neighbouring views.

    Args:
        image: normalised coordinates, any value where not `seen`.
        seen: (F, P) bool.
    """
    neighbours = np.column_stack([np.arange(len(seen) - 1), np.arange(1, len(seen))])
    sigma = estimate_pixel_noise(np.where(seen[..., None], image, 0.0), seen, neighbours)
    return sigma if np.isfinite(sigma) else _USUAL


def _tracked(reconstruction: Reconstruction) -> np.ndarray:
    """(F, P, 2) tracks in normalised coordinates."""
    pixels = np.nan_to_num(reconstruction.pixels)
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    return np.asarray(np.linalg.solve(reconstruction.K[:, None], homogeneous[..., None])[..., :2, 0])
