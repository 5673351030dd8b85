"""What the report shows, worked out once: surfaces and truth in one unit, their triangles, errors and common scales."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.image_scale import log_image_scale
from connrsfm_graph.report.mesh import triangles

Similarity = tuple[float, np.ndarray, np.ndarray]
"""Scale, rotation (3, 3) and translation (3,)."""
_IDENTITY: Similarity = (1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Surfaces:
    """Surfaces of every image, ready to be drawn; where the truth is known they are aligned to it."""

    points: np.ndarray
    """(F, P, 3) recovered points in camera frames; aligned to the truth by a similarity per image where known."""
    truth: np.ndarray | None
    """(F, P, 3) true points, NaN where unknown."""
    error: np.ndarray | None
    """(F, P) distance to the truth in percent of the true surface's largest extent."""
    triangles: tuple[np.ndarray, ...]
    """(T, 3) triangles of recovered points, per image."""
    centre: np.ndarray
    """(F, 3) what a viewer looks at: the middle of each surface."""
    relief: np.ndarray
    """(F, P) depth beyond the middle of its image's surface."""
    log_scale: np.ndarray
    """(F, P) log conformal scale of every image (see `image_scale`), NaN where unknown."""
    to_truth: tuple[Similarity, ...]
    """Scale, rotation and translation per image that aligned its surface to the truth; the identity without."""

    @staticmethod
    def of(reconstruction: Reconstruction, truth: np.ndarray | None = None) -> Surfaces:
        """Arrange a reconstruction and, where known, its truth (F, P, 3).

        Raises:
            InputError: the truth has another shape, or shares fewer than three points with every image.
        """
        points = reconstruction.points
        error = None
        to_truth: tuple[Similarity, ...] = (_IDENTITY,) * len(points)
        if truth is not None:
            if truth.shape != points.shape:
                raise InputError(f"the truth has shape {truth.shape}, the reconstruction {points.shape}")
            points, error, to_truth = _aligned(points, truth)
        known = np.isfinite(points).all(axis=-1)
        parts = []
        centre = np.zeros((len(points), 3))
        for f, frame in enumerate(points):
            image = np.where(known[f][:, None], reconstruction.camera.image(reconstruction.points[f]), np.nan)
            parts.append(triangles(image))
            if known[f].any():
                centre[f] = 0.5 * (frame[known[f]].min(axis=0) + frame[known[f]].max(axis=0))
        relief = points[..., 2] - centre[:, None, 2]
        scale = log_image_scale(reconstruction)
        return Surfaces(points, truth, error, tuple(parts), centre, relief, scale, to_truth)

    @property
    def frames(self) -> list[int]:
        """Images with something to show."""
        return [f for f, part in enumerate(self.triangles) if len(part)]

    def reach(self, R: np.ndarray) -> np.ndarray:
        """(2,) world units to the sides and up and down that a view along rotation R must show to hold every image."""
        if not self.frames:
            return np.ones(2)
        shown = np.abs((self.points - self.centre[:, None])[self.frames] @ R.T)[..., :2]
        # The farthest few points may be gross errors that would shrink everything else.
        return np.nanquantile(shown, 0.995, axis=1).max(axis=0)

    @cached_property
    def radius(self) -> float:
        """World units from the centre that a view from any side must show to hold every image."""
        distance = np.linalg.norm((self.points - self.centre[:, None])[self.frames], axis=2)
        return float(np.nanquantile(distance, 0.995, axis=1).max())

    def relief_range(self) -> tuple[float, float]:
        """Lower and upper end of the depth colours, common to all images."""
        return _quantiles(self.relief, 0.01, 0.99)

    def scale_range(self) -> tuple[float, float]:
        """Ends of the colours of log conformal scale, common to all images and even about 0; at least a percent."""
        largest = max(_quantiles(np.abs(self.log_scale), 0.0, 0.98)[1], 0.01)
        return -largest, largest

    def error_range(self) -> tuple[float, float]:
        """Zero and the upper end of the error colours, common to all images."""
        return 0.0, _quantiles(np.zeros(1) if self.error is None else self.error, 0.0, 0.97)[1]


def _aligned(points: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[Similarity, ...]]:
    """Points (F, P, 3) aligned to the truth per image, their distances (F, P) in percent of its extent, and how."""
    to_truth = [_IDENTITY] * len(points)
    aligned = np.full_like(points, np.nan)
    error = np.full(points.shape[:2], np.nan)
    known_truth = np.isfinite(truth).all(axis=-1)
    common = known_truth & np.isfinite(points).all(axis=-1)
    if (common.sum(axis=1) < 3).all():
        raise InputError("the truth shares fewer than 3 points with the reconstruction in every image")
    for f in np.nonzero(common.sum(axis=1) >= 3)[0]:
        s, R, t = align_similarity(points[f, common[f]], truth[f, common[f]])
        aligned[f] = s * points[f] @ R.T + t
        to_truth[f] = s, R, t
        extent = np.ptp(truth[f, known_truth[f]], axis=0).max()
        error[f] = 100.0 * np.linalg.norm(aligned[f] - truth[f], axis=1) / extent
    return aligned, error, tuple(to_truth)


def _quantiles(values: np.ndarray, lower: float, upper: float) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = (float(value) for value in np.quantile(known, [lower, upper]))
    return low, max(high, low + np.finfo(float).eps * max(abs(low), 1.0))
