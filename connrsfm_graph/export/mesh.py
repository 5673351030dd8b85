"""A depth map as a textured triangle mesh."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class TexturedMesh:
    """A surface in the camera frame of its image (x right, y down, z forward) and where in the image it is seen."""

    points: np.ndarray
    """(V, 3) vertices in the camera frame."""
    normals: np.ndarray
    """(V, 3) unit normals towards the camera."""
    uv: np.ndarray
    """(V, 2) place in the image from (0, 0), its upper left corner, to (1, 1), its lower right corner."""
    triangles: np.ndarray
    """(T, 3) int, counter-clockwise as the camera sees them: by the right-hand rule their normals point towards it."""


def mesh_of_depth(depth: np.ndarray, K: np.ndarray, step: int | None = None) -> TexturedMesh:
    """Mesh of the pixels that have a depth, with a vertex on every `step`-th row and column.

    Vertices just off the surface are moved to its nearest border pixel, so that borders and holes are not jagged.

    Args:
        depth: (H, W) depth along z, NaN where there is no surface.
        K: (3, 3) pinhole intrinsics; pixel centres are whole numbers.
        step: pixels between vertices; `default_step` where None.
    """
    step = default_step(depth) if step is None else step
    known = np.isfinite(depth)
    rows, columns = (np.arange(0, size + step - 1, step).clip(max=size - 1) for size in depth.shape)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    usable = _moved_to_border(pixels, known, step)
    number = np.arange(len(pixels)).reshape(len(rows), len(columns))
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    triangles = np.concatenate([np.stack([a, d, b], axis=1), np.stack([a, c, d], axis=1)])
    triangles = triangles[usable[triangles].all(axis=1)]
    corners = pixels[triangles]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Moved vertices may have met, or turned their triangle over.
    triangles = triangles[first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]]
    used, triangles = np.unique(triangles, return_inverse=True)
    pixels, triangles = pixels[used], triangles.reshape(-1, 3)
    rays = np.linalg.solve(K, np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1).T).T
    points = rays * depth[pixels[:, 1], pixels[:, 0]][:, None]
    uv = (pixels + 0.5) / np.array(depth.shape[::-1])
    return TexturedMesh(points, _normals(points, triangles), uv, triangles)


def _moved_to_border(pixels: np.ndarray, known: np.ndarray, step: int) -> np.ndarray:
    """Move pixels (N, 2) off the surface, in place, to its border less than `step` away; (N,) which are on it then."""
    on_surface = known[pixels[:, 1], pixels[:, 0]]
    inner = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0).astype(bool)
    y, x = np.nonzero(known & ~inner)
    off = np.flatnonzero(~on_surface)
    if len(off) and len(x):
        border = np.stack([x, y], axis=1)
        distance, nearest = cKDTree(border).query(pixels[off], distance_upper_bound=step)
        near = np.isfinite(distance)
        pixels[off[near]] = border[nearest[near]]
        on_surface[off[near]] = True
    return on_surface


def default_step(depth: np.ndarray, cells: int = 160) -> int:
    """Pixels between vertices that give the longer side of the surface about `cells` cells."""
    y, x = np.nonzero(np.isfinite(depth))
    return max(1, round(max(np.ptp(x), np.ptp(y)) / cells)) if len(y) else 1


def _normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals: the mean of the triangles' normals weighted by area."""
    corners = points[triangles]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(points)
    for corner in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(triangles[:, corner], weighted[:, axis], minlength=len(points))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
