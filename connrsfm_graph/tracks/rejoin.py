"""Lost points found again: SIFT matches between distant images say where to look, registration decides.

A point that was covered, left the image or moved too far for following has left a patch behind. An earlier image in
which it was seen is matched with the image at hand; the affinity of the matches around it predicts place and distortion
of its patch, and the point is taken up again where the patch, registered there, looks as it did when first seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from connrsfm_graph.tracks.neighbours import affinity_at, local_affinity

_FEATURES = 2000
"""Strongest features of an image that are described."""
_RATIO = 0.8
"""A match is this much nearer than the second nearest feature (Lowe, IJCV 2004)."""
_AGREE = 3.0
"""Pixels by which a match may miss the affinity of the matches around it."""


@dataclass(frozen=True)
class Features:
    """SIFT features of an image."""

    at: np.ndarray
    """(M, 2) pixels."""
    descriptor: np.ndarray
    """(M, 128) float32 of unit length."""

    @staticmethod
    def of(grey: np.ndarray, on_object: np.ndarray) -> Features:
        """The features of an image (H, W) uint8 that lie in a region (H, W) bool."""
        found, descriptor = cv2.SIFT.create(_FEATURES).detectAndCompute(grey, on_object.astype(np.uint8))
        if descriptor is None:
            return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
        at = np.array([feature.pt for feature in found])
        return Features(at, descriptor / np.maximum(np.linalg.norm(descriptor, axis=1, keepdims=True), 1e-9))


def matches(a: Features, b: Features) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) in both images of features that are each other's nearest by far."""
    if min(len(a.at), len(b.at)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    likeness = a.descriptor @ b.descriptor.T
    nearest = likeness.argmax(axis=1)
    row = np.arange(len(a.at))
    mutual = likeness.argmax(axis=0)[nearest] == row
    # Distances of unit vectors follow from their inner products.
    first, second = -np.partition(-likeness, 1, axis=1)[:, :2].T
    clear = np.sqrt(np.maximum(2 - 2 * first, 0)) < _RATIO * np.sqrt(np.maximum(2 - 2 * second, 0))
    kept = mutual & clear
    return a.at[kept], b.at[nearest[kept]]


def predicted(
    before: np.ndarray, after: np.ndarray, at: np.ndarray, neighbours: int, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points of one image should be in another, from correspondences of which some are wrong.

    Args:
        before, after: (M, 2) pixels that correspond, mostly.
        at: (N, 2) pixels in the first image.
        neighbours: how many correspondences around a point predict it.
        reach: pixels within which at least half of them must lie.

    Returns:
        Which points are predicted (K,), their places (K, 2) in the second image and their affinities (K, 2, 2).
    """
    _, error = local_affinity(before, after, neighbours)
    before, after = before[error < _AGREE], after[error < _AGREE]
    if len(before) < neighbours:
        return np.empty(0, int), np.empty((0, 2)), np.empty((0, 2, 2))
    distance, _ = cKDTree(before).query(at, [(neighbours + 1) // 2])
    (near,) = np.nonzero(distance[:, 0] < reach)
    place, affinity = affinity_at(before, after, at[near], neighbours)
    return near, place, affinity
