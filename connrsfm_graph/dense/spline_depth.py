"""The classical way to a dense depth map: a bicubic B-spline of log depth through the sparse points.

The bending weight is chosen by generalised cross-validation over all images together, so that noise of the points is
smoothed and wrinkles are not. Splines live in pixels, where a grid of places makes their evaluation a product of three
small matrices whatever the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from connrsfm_graph.dense.sparse import SparsePoints
from connrsfm_graph.surface_spline import SurfaceSpline, choose_bending
from connrsfm_graph.warps.basis import VALUE, SplineGrid, axis_rows
from factors.surface import PERSPECTIVE

CONTROL_POINTS = 20
"""Control points per axis at most; below, the square root of the number of points and three more."""


class SplineDepth:
    """Depth maps by splines; fitted for all images, evaluated one at a time."""

    name = "spline"

    def __init__(self, images: Sequence[SparsePoints]) -> None:
        """Fit the log depths of every image's points with one bending weight."""
        self._splines = [log_depth_spline(points.pixels, np.log(points.depth)) for points in images]
        self.bending = choose_bending(self._splines)
        self.expected_error = cross_validated_error(self._splines, self.bending)
        """Root mean square error of log depth that cross-validation expects at a point that was left out."""

    def depth(self, number: int, size: tuple[int, int]) -> np.ndarray:
        """(H, W) depth of every pixel of an image of `size` (W, H); beyond the sparse points an extrapolation."""
        spline = self._splines[number]
        return np.exp(on_grid(spline.grid, spline.control(self.bending), np.arange(size[0]), np.arange(size[1])))

    def depth_at(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """(N,) depth at places (N, 2) of an image."""
        return np.exp(self._splines[number].surface(pixels, self.bending)[0])


def log_depth_spline(pixels: np.ndarray, log_depth: np.ndarray, control_points: int = CONTROL_POINTS) -> SurfaceSpline:
    """Spline fitted to log depths (N,) at places (N, 2)."""
    ones = np.ones(len(pixels))
    return SurfaceSpline(pixels, (VALUE,), log_depth[:, None], ones, pixels, control_points, PERSPECTIVE)


def cross_validated_error(splines: Sequence[SurfaceSpline], bending: float) -> float:
    """Root mean square of the error at points left out, by generalised cross-validation over all splines together."""
    scores = [spline.score(np.array([bending])) for spline in splines]
    rss = sum(float(score[0][0]) for score in scores)
    parameters = sum(float(score[1][0]) for score in scores)
    size = sum(score[2] for score in scores)
    return float(np.sqrt(rss / size) / max(1.0 - parameters / size, 1e-3))


def on_grid(grid: SplineGrid, control: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (len(y), len(x)) of a spline with control points (n * n,) at all combinations of x and y."""
    return axis_matrix(grid, 1, y) @ control.reshape(grid.n, grid.n).T @ axis_matrix(grid, 0, x).T


def axis_matrix(grid: SplineGrid, axis: int, x: np.ndarray) -> np.ndarray:
    """(M, n) weight of every control point along an axis at places x (M,); those off the grid count as its border."""
    local = np.clip((x - grid.origin[axis]) / grid.step[axis], 0.0, grid.n - 3)
    cell = np.minimum(local.astype(np.int64), grid.n - 4)
    matrix = np.zeros((len(x), grid.n))
    matrix[np.arange(len(x))[:, None], cell[:, None] + np.arange(4)] = axis_rows(local - cell)[:, 0]
    return matrix
