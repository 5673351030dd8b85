"""A software rasteriser: triangles, coloured at their corners or by a photo, to an antialiased picture.

Orthographic, with smooth Lambert shading and thin mesh lines. Triangles are painted from far to near with their own
number; what every pixel then shows is worked out from the number it was left with.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

SUPERSAMPLING = 2
LIGHT = np.array([-0.28, -0.50, -0.82]) / np.linalg.norm([-0.28, -0.50, -0.82])
"""Unit direction to the light, from over the viewer's left shoulder."""
AMBIENT = 0.45
PHOTO_AMBIENT = 0.8
"""A photo has light of its own."""
MESH_LINE = 0.88
"""Brightness of mesh lines relative to the surface."""
_SUBPIXEL_BITS = 6


@dataclass(frozen=True)
class View:
    """An orthographic view: pixel = size / 2 + R (X - centre) pixels_per_unit, depth along the third axis."""

    R: np.ndarray
    """(3, 3) rotation from the world to the viewer; axes right, down, forward."""
    pixels_per_unit: float
    """Picture pixels per world unit."""
    size: tuple[int, int]
    """Width and height in pixels."""

    def project(self, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """(P, 3) pixel x, pixel y and depth (in pixels too) of points (P, 3)."""
        width, height = self.size
        return (points - centre) @ self.R.T * self.pixels_per_unit + np.array([0.5 * width, 0.5 * height, 0.0])


def turned(right: float, up: float) -> np.ndarray:
    """Rotation of a viewer who walked around the object by `right` degrees and climbed by `up` degrees."""
    a, b = np.radians([right, up])
    around = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    over = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return over @ around


@dataclass(frozen=True)
class Raster:
    """What each of N pixels shows of a surface, without its colour; pixels are those of the supersampled picture."""

    size: tuple[int, int]
    """Width and height of the picture."""
    at: tuple[np.ndarray, np.ndarray]
    """Row and column (N,) of the pixels."""
    corners: np.ndarray
    """(N, 3) points of the triangle that is seen."""
    bary: np.ndarray
    """(N, 3) barycentric coordinates in it."""
    light: np.ndarray
    """(N,) share of the light that falls on it."""
    on_line: np.ndarray
    """(N,) bool, on a side of the triangle."""

    @staticmethod
    def of(view: View, centre: np.ndarray, points: np.ndarray, triangles: np.ndarray) -> Raster:
        """Look at a surface.

        Args:
            view, centre: where from and at what.
            points: (P, 3); corners of triangles are finite.
            triangles: (T, 3) indices of points.
        """
        s = SUPERSAMPLING
        corners = view.project(points, centre)[triangles] * s
        owner = _painted(corners, view.size[0] * s, view.size[1] * s)
        y, x = np.nonzero(owner >= 0)
        row = owner[y, x]
        bary, to_side = _inside(corners[..., :2], row, x, y)
        n = np.einsum("nk,nkc->nc", bary, _normals(corners, triangles, len(points))[triangles][row])
        # Both sides of a surface are lit, so a side turned away is told by its shape rather than lost in the dark.
        n *= np.where(n[:, 2:] > 0, -1.0, 1.0) / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
        return Raster(
            view.size, (y, x), triangles[row], bary, np.maximum(n @ LIGHT, 0.0).astype(np.float32), to_side < 0.5 * s
        )

    def coloured(self, colours: np.ndarray, lines: bool = True) -> np.ndarray:
        """Picture (height, width, 4) uint8 red, green, blue, alpha of a surface with colours (P, 3) in 0 to 1.

        Transparent where there is no surface; `lines` draws the sides of the triangles.
        """
        shade = AMBIENT + (1.0 - AMBIENT) * self.light
        if lines:
            shade = np.where(self.on_line, MESH_LINE * shade, shade)
        return self._picture(np.einsum("nk,nkc->nc", self.bary, colours[self.corners]) * shade[:, None])

    def textured(self, places: np.ndarray, photo: np.ndarray) -> np.ndarray:
        """The same of a surface whose points show pixels (P, 2) of a photo (h, w, 3) uint8."""
        shade = PHOTO_AMBIENT + (1.0 - PHOTO_AMBIENT) * self.light
        colour = _sampled(photo, np.einsum("nk,nkc->nc", self.bary, places[self.corners]))
        return self._picture(colour * shade[:, None])

    def _picture(self, values: np.ndarray) -> np.ndarray:
        s, (width, height) = SUPERSAMPLING, self.size
        picture = np.zeros((height * s, width * s, 4), dtype=np.float32)
        picture[(*self.at, slice(3))] = values
        picture[(*self.at, 3)] = 1.0
        small = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))  # means of s x s pixels
        colour, alpha = small[..., :3], small[..., 3:]
        small = np.concatenate([colour / np.maximum(alpha, 1e-12), alpha], axis=2)
        return np.round(255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8)


def _sampled(photo: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(N, 3) in 0 to 1, the photo between its pixels at places (N, 2)."""
    if not len(place):
        return np.empty((0, 3))
    x, y = np.clip(place, 0, np.array(photo.shape[1::-1]) - 1.001).T
    column, row = x.astype(int), y.astype(int)
    x, y = (x - column)[:, None].astype(np.float32), (y - row)[:, None].astype(np.float32)
    above = (1 - x) * photo[row, column] + x * photo[row, column + 1]
    below = (1 - x) * photo[row + 1, column] + x * photo[row + 1, column + 1]
    return np.asarray((1 - y) * above + y * below) / 255.0


def _painted(corners: np.ndarray, width: int, height: int) -> np.ndarray:
    """(height, width) number of the triangle that is seen, -1 where none, by painting from far to near."""
    owner = np.full((height, width), -1, dtype=np.int32)
    # Pixel centres are at halves here and at whole numbers for cv2.
    place = np.round((corners[..., :2] - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)
    for triangle in np.argsort(-corners[..., 2].mean(axis=1), kind="stable"):
        cv2.fillConvexPoly(owner, place[triangle], int(triangle), cv2.LINE_8, _SUBPIXEL_BITS)
    return owner


def _inside(corners: np.ndarray, row: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates (N, 3) of pixels in their triangles, and their distances (N,) to the nearest side."""
    origin = corners[:, 0]
    b, c = corners[:, 1] - origin, corners[:, 2] - origin
    twice_area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    twice_area = np.where(np.abs(twice_area) < 1e-9, 1e-9, twice_area)
    dx, dy = x + 0.5 - origin[row, 0], y + 0.5 - origin[row, 1]
    second = dx * (c[:, 1] / twice_area)[row] - dy * (c[:, 0] / twice_area)[row]
    third = dy * (b[:, 0] / twice_area)[row] - dx * (b[:, 1] / twice_area)[row]
    # Painting reaches half a pixel over a triangle's sides.
    bary = np.clip(np.stack([1.0 - second - third, second, third], axis=1), 0.0, 1.0)
    bary /= bary.sum(axis=1, keepdims=True)
    opposite = np.linalg.norm(np.stack([c - b, c, b], axis=1), axis=2)
    altitude = np.abs(twice_area)[:, None] / np.maximum(opposite, 1e-12)
    bary = bary.astype(np.float32)  # many pixels: half the memory to go through
    return bary, (bary * altitude.astype(np.float32)[row]).min(axis=1)


def _normals(corners: np.ndarray, triangles: np.ndarray, n_points: int) -> np.ndarray:
    """(P, 3) normals of points: the mean of their triangles' normals weighted by area."""
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((n_points, 3))
    np.add.at(normals, triangles.ravel(), np.repeat(weighted, 3, axis=0))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
