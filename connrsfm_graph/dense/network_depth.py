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

TOGETHER = 16
"""Images that the network answers at a time."""
BORDER = 3.0
"""Pixels of the network's image along the border of the surface where slopes stand in for the network's answer."""


class NetworkDepth:
    """Depth maps by a trained network; predicted for all images, evaluated one at a time."""

    name = "network"

    def __init__(self, checkpoint: Checkpoint, images: Sequence[SparsePoints]) -> None:
        """Predict every image and fit the corrections."""
        self._shapes = [
            shape
            for start in range(0, len(images), TOGETHER)
            for shape in _shapes(checkpoint, images[start : start + TOGETHER])
        ]
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

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """(N,) log depth at pixels (N, 2)."""
        p = self.window.places(pixels)
        return self.spline(p[:, 1], p[:, 0], grid=False)

    def on_grid(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(len(y), len(x)) log depth at all combinations of x and y in pixels."""
        centre, half = self.window.centre, self.window.half
        return self.spline((y - centre[1]) / half[1], (x - centre[0]) / half[0])


def _shapes(checkpoint: Checkpoint, images: Sequence[SparsePoints]) -> list[_Shape]:
    """Predict the shapes of some images' surfaces together."""
    size = checkpoint.size
    windows = [Window.around(points.pixels, points.K) for points in images]
    places = [window.places(points.pixels) for window, points in zip(windows, images, strict=True)]
    masks = np.stack([surface_region((p + 1.0) * (size / 2) - 0.5, (size, size)) for p in places])
    normals = np.concatenate(
        [
            normal_images(p[None], window.encode(points.normals, p)[None], np.ones((1, len(p))), size)
            for window, points, p in zip(windows, images, places, strict=True)
        ]
    )
    log_depth = predict(checkpoint.network, normals, masks)
    axis, box = grid(size), [-1.0, 1.0, -1.0, 1.0]
    return [
        _Shape(window, RectBivariateSpline(axis, axis, _continued(answer, slopes(image), mask), bbox=box))
        for window, answer, image, mask in zip(windows, log_depth, normals, masks, strict=True)
    ]


def _continued(log_depth: np.ndarray, g: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Log depth (S, S) of the surface's inside, continued over its border and beyond by the slopes g (S, S, 2).

    Interpolation needs neighbours off the surface, where the network's answer means nothing, and at the border itself,
    in corners above all, the network knows least; the slopes are known there.
    """
    depth_inside = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    inside = depth_inside > min(BORDER, 0.5 * depth_inside.max())
    rows, columns = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    y, x = np.indices(mask.shape)
    slope = 0.5 * (g[rows, columns] + g) * (2.0 / len(mask))
    return log_depth[rows, columns] + slope[..., 0] * (x - columns) + slope[..., 1] * (y - rows)


def _root_mean_square_slope(points: SparsePoints) -> float:
    window = Window.around(points.pixels, points.K)
    g = slopes(window.encode(points.normals, window.places(points.pixels)))
    return float(np.sqrt((g**2).sum(axis=-1).mean()))
