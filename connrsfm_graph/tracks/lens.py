"""Lens distortion: tracks and images as an ideal pinhole camera would have seen them.

Brown's model with the parameters and their order as OpenCV's calibration gives them: an ideal ray (x, y) with
r2 = x^2 + y^2 is seen at

    x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2),   y likewise.
"""

from __future__ import annotations

import cv2
import numpy as np

from connrsfm_graph.errors import InputError

_ITERATIONS = 100
_PRECISION = 1e-3
"""Pixels by which a point may miss itself when it is undistorted and distorted again."""


def parse_distortion(text: str) -> np.ndarray:
    """The (4,) or (5,) parameters of "k1,k2,p1,p2[,k3]".

    Raises:
        InputError: not four or five finite numbers.
    """
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.empty(0)
    if len(values) not in (4, 5) or not np.isfinite(values).all():
        raise InputError(f"distortion '{text}': expected k1,k2,p1,p2 or k1,k2,p1,p2,k3")
    return values


def undistort_pixels(pixels: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Where a camera K (3, 3) without distortion would have seen pixels (..., 2); NaN stays NaN.

    Raises:
        InputError: the lens model folds the image over where there are pixels, so that they belong to no ray.
    """
    ideal = np.full(pixels.shape, np.nan)
    known = np.isfinite(pixels).all(axis=-1)
    if not known.any():
        return ideal
    to_rays = np.linalg.inv(K)
    seen = pixels[known] @ to_rays[:2, :2].T + to_rays[:2, 2]
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ITERATIONS, 1e-12)
    rays = cv2.undistortPoints(seen[:, None], np.eye(3), distortion, criteria=stop).reshape(-1, 2)
    again = cv2.projectPoints(cv2.convertPointsToHomogeneous(rays), np.zeros(3), np.zeros(3), np.eye(3), distortion)[0]
    missed = K[0, 0] * np.linalg.norm(again.reshape(-1, 2) - seen, axis=1)
    if not missed.max() < _PRECISION:
        x, y = pixels[known][np.argmax(np.where(np.isfinite(missed), missed, np.inf))]
        raise InputError(
            f"distortion: no ray is seen at pixel ({x:.0f}, {y:.0f}); the parameters do not belong to this camera"
        )
    ideal[known] = rays @ K[:2, :2].T + K[:2, 2]
    return ideal


def undistort_image(image: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """The image (H, W, C) that the same camera K (3, 3) without distortion would have taken, black where unseen."""
    return np.asarray(cv2.undistort(image, K, distortion))
