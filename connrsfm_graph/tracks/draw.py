"""A picture of the tracks on an image."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

from connrsfm_graph.tracks.tracks import Tracks

_SHIFT = 4
"""Fractional bits of the drawn coordinates."""


def draw_tracks(image: np.ndarray, tracks: Tracks, frame: int, tail: int = 3) -> np.ndarray:
    """Draw every point visible in a frame and where it came from.

    The hue of a point is its place in the image where it was first seen, so that colours are smooth where tracks are
    right and a point that jumped stands out.

    Args:
        image: (H, W, 3) uint8, the image of that frame; not changed.
        tracks: the tracks.
        frame: number of the image.
        tail: how many earlier images the line behind a point reaches back.

    Returns:
        (H, W, 3) uint8, a picture of the same size.
    """
    picture = image.copy()
    thick = max(1, round(max(image.shape[:2]) / 900))
    first = tracks.visible.argmax(axis=0)
    born = tracks.pixels[first, np.arange(tracks.n_points)]
    centre = np.nanmedian(born, axis=0)
    hue = np.arctan2(*(born - centre).T) / (2 * np.pi)
    for point in np.flatnonzero(tracks.visible[frame]):
        colour = tuple(round(255 * c) for c in colorsys.hsv_to_rgb(float(hue[point]) % 1.0, 0.9, 1.0))
        path = tracks.pixels[max(0, frame - tail) : frame + 1, point]
        path = path[np.isfinite(path).all(axis=1)]
        fixed = np.round(path * 2**_SHIFT).astype(np.int32)
        cv2.polylines(picture, [fixed], False, colour, thick, cv2.LINE_AA, _SHIFT)
        x, y = fixed[-1].tolist()
        for radius, shade in ((3 * thick, (20, 20, 20)), (2 * thick, colour)):
            cv2.circle(picture, (x, y), radius << _SHIFT, shade, -1, cv2.LINE_AA, _SHIFT)
    return picture
