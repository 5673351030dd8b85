"""Dense depth maps by the network: from the normals of an image's points, corrected by their depths.

The network answers for the shape that the normals describe. What its log depth lacks at the sparse points, the free
constant included, is a smooth function over the image and is put back as a spline: the dense surface agrees with the
sparse points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt

from connrsfm_graph.dense.checkpoint import Checkpoint
from connrsfm_graph.dense.field import normal_images
from connrsfm_graph.dense.network import predict
from connrsfm_graph.dense.region import surface_region
from connrsfm_graph.dense.simulated import OBSERVED
from connrsfm_graph.dense.sparse import SparsePoints
from connrsfm_graph.dense.spline_depth import cross_validated_error, log_depth_spline, on_grid
from connrsfm_graph.dense.window import Window, grid, slopes

CORRECTION_POINTS = 14
"""Control points per axis of the correction, at most."""
CORRECTION_BENDING = 1e-4
"""Bending weight of the correction. What the network lacks is no noise, and cross-validation would follow it closely
where there are points and anywhere at all where there are none."""


class NetworkDepth:
    """Depth maps by a trained network; predicted for all images, evaluated one at a time."""

    name = "network"

    def __init__(self, checkpoint: Checkpoint, images: Sequence[SparsePoints]) -> None:
        """Predict every image and fit the corrections."""
        self._shapes = [_Shape.of(checkpoint, points) for points in images]
        self._corrections = [
            log_depth_spline(points.pixels, np.log(points.depth) - shape.at(points.pixels), CORRECTION_POINTS)
            for points, shape in zip(images, self._shapes, strict=True)
        ]
        self.expected_error = cross_validated_error(self._corrections, CORRECTION_BENDING)
        """Root mean square error of log depth that cross-validation expects at a point that was left out."""

    def depth(self, number: int, size: tuple[int, int]) -> np.ndarray:
        """(H, W) depth of every pixel of an image of `size` (W, H); off the sparse points' region it means nothing."""
        correction = self._corrections[number]
        x, y = np.arange(size[0]), np.arange(size[1])
        added = on_grid(correction.grid, correction.control(CORRECTION_BENDING), x, y)
        return np.exp(self._shapes[number].on_grid(x, y) + added)

    def depth_at(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """(N,) depth at places (N, 2) of an image."""
        added = self._corrections[number].surface(pixels, CORRECTION_BENDING)[0]
        return np.exp(self._shapes[number].at(pixels) + added)


def unfit(checkpoint: Checkpoint, images: Sequence[SparsePoints]) -> str | None:
    """Why the images are outside of what a checkpoint was trained on, one phrase; None where they are inside."""
    fewest = min(map(len, images))
    if fewest < OBSERVED[0]:
        return f"an image has {fewest} points, the network was trained on {OBSERVED[0]} and more"
    steepest = max(_root_mean_square_slope(points) for points in images)
    if steepest > checkpoint.slope_range:
        return f"surfaces are as steep as {steepest:.2f}, the network was trained up to {checkpoint.slope_range:.2f}"
    return None


@dataclass(frozen=True)
class _Shape:
    """The network's log depth over a window, up to a constant, as a smooth function."""

    window: Window
    spline: RectBivariateSpline
    """By window coordinates, the second one first."""

    @staticmethod
    def of(checkpoint: Checkpoint, points: SparsePoints) -> _Shape:
        """Predict the shape of one image's surface."""
        size = checkpoint.size
        window = Window.around(points.pixels, points.K)
        p = window.places(points.pixels)
        m = window.encode(points.normals, p)
        mask = surface_region((p + 1.0) * (size / 2) - 0.5, (size, size))
        images = normal_images(p[None], m[None], np.ones((1, len(p))), size)
        log_depth = predict(checkpoint.network, images, mask[None])[0]
        places = grid(size)
        continued = _continued(log_depth, slopes(images[0]), mask)
        return _Shape(window, RectBivariateSpline(places, places, continued, bbox=[-1.0, 1.0, -1.0, 1.0]))

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """(N,) log depth at pixels (N, 2)."""
        p = self.window.places(pixels)
        return self.spline(p[:, 1], p[:, 0], grid=False)

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(len(y), len(x)) log depth at all combinations of x and y in pixels."""
        centre, half = self.window.centre, self.window.half
        return self.spline((y - centre[1]) / half[1], (x - centre[0]) / half[0])


def _continued(log_depth: np.ndarray, g: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Log depth (S, S) continued off the surface by the slopes g (S, S, 2) of the nearest pixel on it.

    Interpolation between pixels needs neighbours beyond the border, where the network's answer means nothing.
    """
    rows, columns = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    y, x = np.indices(mask.shape)
    cell = 2.0 / len(mask)
    slope = g[rows, columns] * cell
    return log_depth[rows, columns] + slope[..., 0] * (x - columns) + slope[..., 1] * (y - rows)


def _root_mean_square_slope(points: SparsePoints) -> float:
    window = Window.around(points.pixels, points.K)
    g = slopes(window.encode(points.normals, window.places(points.pixels)))
    return float(np.sqrt((g**2).sum(axis=-1).mean()))
