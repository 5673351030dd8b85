"""The input images as the report shows them: cut to where the tracks are, small, as JPEG."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

LONGEST = 560
"""Longest side of a photo in pixels."""
_MARGIN = 0.12
"""Around the tracks of all images, as a share of their extent."""
_QUALITY = 82


@dataclass(frozen=True)
class Photo:
    """The part of an image that shows the object."""

    image: np.ndarray
    """(h, w, 3) uint8 RGB."""
    corner: np.ndarray
    """(2,) pixel of the whole image at which the part begins, its upper left corner."""
    scale: float
    """Pixels of the photo per pixel of the image, at most 1."""

    def place(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of the whole image as pixels of the photo; pixel centres are at whole numbers in both."""
        return self.scale * (pixels - self.corner + 0.5) - 0.5

    def jpeg(self) -> str:
        """The photo as an address that a page can hold."""
        bgr = cv2.cvtColor(self.image, cv2.COLOR_RGB2BGR)
        done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        assert done
        return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def photos_of(images: Iterable[np.ndarray], pixels: np.ndarray, longest: int = LONGEST) -> list[Photo]:
    """One photo per image, all of the same part of the picture.

    Args:
        images: F images (H, W[, 3]) uint8 RGB; each is read once and not kept.
        pixels: (F, P, 2) tracks, NaN where not visible.
        longest: longest side in pixels.
    """
    lower, upper = np.nanmin(pixels, axis=(0, 1)), np.nanmax(pixels, axis=(0, 1))
    margin = _MARGIN * (upper - lower).max()
    left, top = np.maximum(np.floor(lower - margin), 0).astype(int)
    right, bottom = np.ceil(upper + margin).astype(int) + 1
    photos = []
    for image in images:
        part = image[top:bottom, left:right]
        if part.ndim == 2:
            part = cv2.cvtColor(part, cv2.COLOR_GRAY2RGB)
        scale = min(longest / max(part.shape[:2]), 1.0)
        small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else part.copy()
        photos.append(Photo(small, np.array([left, top], float), scale))
    return photos
