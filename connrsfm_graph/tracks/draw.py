"""Pictures of the tracks on their images."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np

from connrsfm_graph.tracks.tracks import Tracks

_SHIFT = 4
"""Fractional bits of the drawn coordinates."""
_SHOWN = 6
"""Images in the picture of a sequence, at most."""
_WIDTH = 1800
"""Of that picture, in pixels."""
_COLUMNS = 3


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


def draw_sequence(images: Iterable[np.ndarray], tracks: Tracks) -> np.ndarray:
    """Up to six images of a sequence with their tracks, evenly spread, cut to where tracks are: (H, W, 3) uint8.

    Args:
        images: every image (H, W, 3) uint8 of the tracks, in order.
        tracks: the tracks.
    """
    shown = set(np.linspace(0, tracks.n_frames - 1, min(_SHOWN, tracks.n_frames)).round().astype(int).tolist())
    lower, upper = np.nanmin(tracks.pixels, axis=(0, 1)), np.nanmax(tracks.pixels, axis=(0, 1))
    margin = 0.1 * (upper - lower).max()
    left, top = np.maximum(lower - margin, 0).astype(int)
    right, bottom = np.ceil(upper + margin).astype(int)
    cells = []
    for frame, image in enumerate(images):
        if frame in shown:
            scale = max(_WIDTH / _COLUMNS / (min(right, image.shape[1]) - left), 1e-3)
            large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            # Pixel centres are at whole coordinates before and after.
            moved = replace(tracks, pixels=scale * (tracks.pixels + 0.5) - 0.5)
            x, y, x_end, y_end = (round(scale * edge) for edge in (left, top, right, bottom))
            cells.append(draw_tracks(large, moved, frame)[y:y_end, x:x_end])
    cells += [np.zeros_like(cells[0])] * (-len(cells) % _COLUMNS)
    return np.concatenate([np.concatenate(cells[i : i + _COLUMNS], axis=1) for i in range(0, len(cells), _COLUMNS)])
