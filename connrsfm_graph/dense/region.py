"""Where an image shows the surface: the pixels between its sparse points, not the holes nor what lies outside."""

from __future__ import annotations

import cv2
import numpy as np

from connrsfm_graph.report.mesh import triangles

_SUBPIXEL_BITS = 6


def surface_region(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mask (H, W) of the pixels inside the Delaunay triangles of the points, without those that bridge gaps.

    Args:
        pixels: (N, 2) sparse points in pixels.
        size: width and height of the image.
    """
    mask = np.zeros(size[::-1], np.uint8)
    for corners in np.round(pixels[triangles(pixels)] * 2**_SUBPIXEL_BITS).astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1, cv2.LINE_8, _SUBPIXEL_BITS)
    return mask.astype(bool)
