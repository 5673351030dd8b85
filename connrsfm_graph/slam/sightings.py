"""What a reconstruction without poses says about the world: every surface point on its sight ray, at a depth.

A sighting is one point in one view: its image point with the image noise, and its log depth in the reconstruction's
unit with a standard deviation. The noise levels that a reconstruction does not state follow from how neighbouring
views fit onto each other (`estimate_noise`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.warps.noise import estimate_pixel_noise

_FEWEST = 4
"""Shared points from which two views can be fitted onto each other with something left to see the noise by."""
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


@dataclass(frozen=True)
class View:
    """The N points that one view saw."""

    points: np.ndarray
    """(N,) int, their numbers, each once."""
    image: np.ndarray
    """(N, 2) normalised image coordinates."""
    log_depth: np.ndarray
    """(N,) log depth in the reconstruction's unit."""
    depth_std: np.ndarray
    """(N,) standard deviation of log depth, NaN where not known."""

    @staticmethod
    def checked(
        points: np.ndarray, image: np.ndarray, log_depth: np.ndarray, depth_std: np.ndarray | None = None
    ) -> View:
        """Validate arrays of the shapes above.

        Raises:
            InputError: shapes do not fit, a point is seen twice, or one is not finite.
        """
        points = np.asarray(points, dtype=int)
        image, log_depth = np.asarray(image, dtype=float), np.asarray(log_depth, dtype=float)
        N = len(points)
        depth_std = np.full(N, np.nan) if depth_std is None else np.asarray(depth_std, dtype=float)
        if image.shape != (N, 2) or log_depth.shape != (N,) or depth_std.shape != (N,):
            raise InputError(
                f"{N} points with image {image.shape}, log_depth {log_depth.shape} and depth_std {depth_std.shape}, "
                f"expected ({N}, 2) and twice ({N},)"
            )
        if len(np.unique(points)) != N:
            raise InputError("a point is seen twice, expected each once")
        bad = ~(np.isfinite(image).all(axis=1) & np.isfinite(log_depth))
        if bad.any():
            raise InputError(f"point {points[bad][0]} is not a finite image point and depth")
        return View(points, image, log_depth, depth_std)

    def camera_points(self) -> np.ndarray:
        """(N, 3) in the camera frame, in the reconstruction's unit."""
        return np.exp(self.log_depth)[:, None] * np.column_stack([self.image, np.ones(len(self.image))])


@dataclass(frozen=True)
class Sightings:
    """Points in views, in normalised image coordinates. Entries that are not `seen` are 0."""

    image: np.ndarray
    """(F, P, 2) normalised image coordinates."""
    seen: np.ndarray
    """(F, P) bool."""
    log_depth: np.ndarray
    """(F, P) log depth in the reconstruction's unit."""
    depth_std: np.ndarray
    """(F, P) standard deviation of log depth, NaN where not known."""

    @property
    def n_views(self) -> int:
        return self.seen.shape[0]

    @property
    def n_points(self) -> int:
        return self.seen.shape[1]

    @staticmethod
    def checked(
        image: np.ndarray, log_depth: np.ndarray, seen: np.ndarray, depth_std: np.ndarray | None = None
    ) -> Sightings:
        """Validate arrays of the shapes above.

        Raises:
            InputError: shapes do not fit, or a seen point is not finite; the message names point and view.
        """
        seen = np.asarray(seen, dtype=bool)
        image, log_depth = np.asarray(image, dtype=float), np.asarray(log_depth, dtype=float)
        depth_std = np.full(seen.shape, np.nan) if depth_std is None else np.asarray(depth_std, dtype=float)
        if image.shape != (*seen.shape, 2) or log_depth.shape != seen.shape or depth_std.shape != seen.shape:
            raise InputError(
                f"sightings: image {image.shape}, log_depth {log_depth.shape}, seen {seen.shape} and depth_std "
                f"{depth_std.shape} do not fit, expected (F, P, 2) and three times (F, P)"
            )
        bad = seen & ~(np.isfinite(image).all(axis=-1) & np.isfinite(log_depth))
        if bad.any():
            view, point = np.argwhere(bad)[0]
            raise InputError(f"sightings: point {point} of view {view} is not a finite image point and depth")
        return Sightings(
            np.where(seen[..., None], image, 0.0),
            seen,
            np.where(seen, log_depth, 0.0),
            np.where(seen & (depth_std > 0), depth_std, np.nan),
        )

    @staticmethod
    def of(reconstruction: Reconstruction) -> Sightings:
        """Sightings of the observed points of a reconstruction; interpolated points and outliers are left out."""
        recovered = reconstruction.recovered
        seen = recovered & reconstruction.visible & ~reconstruction.interpolated & ~reconstruction.outlier
        points = np.where(recovered[..., None], reconstruction.points, 1.0)
        return Sightings.checked(
            points[..., :2] / points[..., 2:],
            np.log(points[..., 2]),
            seen,
            reconstruction.depth_std / points[..., 2],
        )

    def points(self) -> np.ndarray:
        """(F, P, 3) points in the camera frames, in the reconstruction's unit; meaningless where not seen."""
        return np.exp(self.log_depth)[..., None] * np.concatenate([self.image, np.ones((*self.seen.shape, 1))], axis=-1)

    def view(self, view: int) -> View:
        """What one view saw."""
        (points,) = np.nonzero(self.seen[view])
        return View(points, self.image[view, points], self.log_depth[view, points], self.depth_std[view, points])


def stacked(views: list[View], rows: list[np.ndarray], points: np.ndarray) -> Sightings:
    """Some rows of some views as arrays over (view, point); `points` are the numbers of the columns, ascending."""
    shape = len(views), len(points)
    image, seen = np.zeros((*shape, 2)), np.zeros(shape, dtype=bool)
    log_depth, depth_std = np.zeros(shape), np.full(shape, np.nan)
    for n, (view, row) in enumerate(zip(views, rows, strict=True)):
        column = np.searchsorted(points, view.points[row])
        seen[n, column] = True
        image[n, column], log_depth[n, column] = view.image[row], view.log_depth[row]
        depth_std[n, column] = view.depth_std[row]
    return Sightings(image, seen, log_depth, depth_std)


def estimate_noise(sightings: Sightings, image_sigma: float | None = None) -> FusionNoise:
    """Noise levels from the fit of neighbouring views onto each other, without any truth.

    Each view is fitted to the next by a similarity. What remains across the sight rays is motion; what remains along
    them beyond that is noise of the two depths; the scales of the similarities are the drift of the unit. Medians over
    all points, so that a minority of wrong tracks does not matter. Where the depths' errors are alike in neighbouring
    views, as those of a reconstruction are, the estimate of the depth is their change only.

    Args:
        sightings: two views or more.
        image_sigma: noise of the image points, normalised coordinates; estimated from image warps where None.

    Raises:
        InputError: no two neighbouring views share enough points.
    """
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
    if image_sigma is None:
        neighbours = np.column_stack([np.arange(sightings.n_views - 1), np.arange(1, sightings.n_views)])
        image_sigma = estimate_pixel_noise(sightings.image, sightings.seen, neighbours)
    image_sigma = image_sigma if np.isfinite(image_sigma) else 1e-3
    floor = 0.1 * image_sigma
    return FusionNoise(
        image=max(image_sigma, 1e-6),
        depth=max(np.sqrt(max(radial_std**2 - motion**2, 0.0) / 2.0) / distance, floor),
        motion=max(motion, floor * distance),
        scale=max(_MAD * float(np.median(np.abs(scales))), 1e-3),
    )
