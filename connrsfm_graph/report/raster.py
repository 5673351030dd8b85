"""A software rasteriser: triangles with colours at their corners to an antialiased picture.

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


def render(
    view: View, centre: np.ndarray, points: np.ndarray, colours: np.ndarray, triangles: np.ndarray
) -> np.ndarray:
    """Picture (height, width, 4), uint8 red, green, blue, alpha, transparent where there is no surface.

    Args:
        view, centre: where to look from and at what.
        points: (P, 3); corners of triangles are finite.
        colours: (P, 3) red, green, blue in 0 to 1.
        triangles: (T, 3) indices of points.
    """
    s = SUPERSAMPLING
    width, height = view.size[0] * s, view.size[1] * s
    corners = view.project(points, centre)[triangles] * s
    owner = _painted(corners, width, height)
    y, x = np.nonzero(owner >= 0)
    row = owner[y, x]
    bary, to_side = _inside(corners[..., :2], row, x, y)
    colour = np.einsum("nk,nkc->nc", bary, colours[triangles][row])
    n = np.einsum("nk,nkc->nc", bary, _normals(corners, triangles, len(points))[triangles][row])
    # Both sides of a surface are lit, so a side turned away is told by its shape rather than lost in the dark.
    n *= np.where(n[:, 2:] > 0, -1.0, 1.0) / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    shade = AMBIENT + (1.0 - AMBIENT) * np.maximum(n @ LIGHT, 0.0)
    shade[to_side < 0.5 * s] *= MESH_LINE
    picture = np.zeros((height, width, 4))
    picture[y, x, :3] = colour * shade[:, None]
    picture[y, x, 3] = 1.0
    picture = picture.reshape(view.size[1], s, view.size[0], s, 4).mean(axis=(1, 3))
    picture[..., :3] /= np.maximum(picture[..., 3:], 1e-12)
    return np.round(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)


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
    return bary, (bary * altitude[row]).min(axis=1)


def _normals(corners: np.ndarray, triangles: np.ndarray, n_points: int) -> np.ndarray:
    """(P, 3) normals of points: the mean of their triangles' normals weighted by area."""
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((n_points, 3))
    np.add.at(normals, triangles.ravel(), np.repeat(weighted, 3, axis=0))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
