"""A depth map as a textured triangle mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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

    Cells of the vertex grid become triangles only where all their corners have a depth: holes stay holes.

    Args:
        depth: (H, W) depth along z, NaN where there is no surface.
        K: (3, 3) pinhole intrinsics; pixel centres are whole numbers.
        step: pixels between vertices; `default_step` where None.
    """
    step = default_step(depth) if step is None else step
    grid = depth[::step, ::step]
    known = np.isfinite(grid)
    number = np.full(grid.shape, -1)
    whole = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    used = np.zeros_like(known)
    for corner in (used[:-1, :-1], used[1:, :-1], used[:-1, 1:], used[1:, 1:]):
        corner |= whole
    y, x = np.nonzero(used)
    number[y, x] = np.arange(len(y))
    a, b, c, d = (part[whole] for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    triangles = np.concatenate([np.stack([a, d, b], axis=1), np.stack([a, c, d], axis=1)])
    pixels = np.stack([x, y], axis=1) * float(step)
    rays = np.linalg.solve(K, np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1).T).T
    points = rays * grid[y, x][:, None]
    uv = (pixels + 0.5) / np.array(depth.shape[::-1])
    return TexturedMesh(points, _normals(points, triangles), uv, triangles)


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
