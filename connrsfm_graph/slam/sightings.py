"""What a reconstruction without poses says about the world: every surface point on its sight ray, at a depth.

A sighting is one point in one view: its image point with the image noise, and its log depth in the reconstruction's
unit with a standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.reconstruction import Reconstruction


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
        if N and points.min() < 0:
            raise InputError(f"a point has number {points.min()}, expected 0 or more")
        bad = ~(np.isfinite(image).all(axis=1) & np.isfinite(log_depth))
        if bad.any():
            raise InputError(f"point {points[bad][0]} is not a finite image point and depth")
        return View(points, image, log_depth, np.where(depth_std > 0, depth_std, np.nan))

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
        """Sightings of the observed points of a reconstruction; interpolated points and outliers are left out.

        Raises:
            InputError: the camera was orthographic, which has no place in the world.
        """
        if not reconstruction.camera.kappa:
            raise InputError(
                "the reconstruction is of an orthographic camera, which has no place; expected perspective"
            )
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
