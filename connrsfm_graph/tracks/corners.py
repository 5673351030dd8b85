"""Where following is worth starting: corners spread evenly over the object."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

_BLOCK = 5
"""Side in pixels of the patch whose gradients make a corner."""
_FLOOR = 0.005
"""Weakest corner taken, as a share of the image's strongest one; weaker ones are noise."""
_BLACK = 8
"""Grey level (0 to 255) up to which a large area is taken for background that was cut away."""
_SPECK = 0.1
"""Areas smaller than this share of the largest one are not the object."""


def corners(grey: np.ndarray, on_object: np.ndarray, cell: float, taken: np.ndarray) -> np.ndarray:
    """The strongest corner (Shi and Tomasi's smaller eigenvalue) of every cell of the image without a point.

    Args:
        grey: (H, W) uint8.
        on_object: (H, W) bool, where corners may lie.
        cell: side of a cell in pixels; corners keep half of it from each other and all of it from points taken.
        taken: (N, 2) pixels of the points already there.

    Returns:
        (M, 2) float32 whole pixels (x, y).
    """
    strength = np.where(on_object, cv2.cornerMinEigenVal(grey, _BLOCK), 0.0)
    peak = cv2.dilate(strength, np.ones((3, 3), np.uint8)) == strength
    y, x = np.nonzero(peak & (strength > _FLOOR * strength.max()))
    order = np.argsort(-strength[y, x], kind="stable")
    x, y = x[order], y[order]
    row, column = (y // cell).astype(int), (x // cell).astype(int)
    _, best = np.unique(row * grey.shape[1] + column, return_index=True)  # a cell's first is its strongest
    best.sort()
    found = np.column_stack([x[best], y[best]]).astype(np.float32)
    if len(taken) and len(found):
        found = found[cKDTree(taken).query(found)[0] > cell]
    if len(found):
        pairs = cKDTree(found).query_pairs(cell / 2, output_type="ndarray")
        found = np.delete(found, np.unique(pairs.max(axis=1)), axis=0)  # the later of a pair is the weaker
    return found


def not_black(grey: np.ndarray, patch: int) -> np.ndarray:
    """(H, W) bool, everything but large black areas and specks; gaps smaller than a patch are closed."""
    bright = (cv2.blur(grey, (3, 3)) > _BLACK).astype(np.uint8)
    closed = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((patch, patch), np.uint8))
    _, label, statistics, _ = cv2.connectedComponentsWithStats(closed)
    area = statistics[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0.0  # label 0 is the black rest
    return np.asarray((area > 0) & (area >= _SPECK * area.max()))[label]


def inside(region: np.ndarray, margin: float) -> np.ndarray:
    """The part of a region (H, W) further than `margin` pixels from its border; the image's own border is none."""
    distance = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(region & (distance > margin))
