"""A printed textile pattern with many corners, no two places alike."""

from __future__ import annotations

import cv2
import numpy as np

_PAPER = (238, 231, 215)
_INKS = ((188, 60, 48), (36, 84, 120), (222, 156, 44), (58, 122, 96), (52, 48, 56), (214, 112, 92), (120, 168, 178))
_MOTIFS_ACROSS = 22
_SHIFT = 4
"""Fractional bits of drawn coordinates."""


def printed_pattern(size: tuple[float, float], width: int, rng: np.random.Generator) -> np.ndarray:
    """A pattern for a sheet.

    Args:
        size: width and height of the sheet in any unit.
        width: width of the pattern in pixels.
        rng: where kinds, places, sizes, turns and colours of the motifs come from.

    Returns:
        (H, width, 3) uint8, red, green, blue.
    """
    height = round(width * size[1] / size[0])
    pattern = np.full((height, width, 3), _PAPER, np.uint8)
    step = width / _MOTIFS_ACROSS
    for row in range(round(height / step)):
        for column in range(_MOTIFS_ACROSS):
            centre = (np.array([column + 0.5 * (row % 2) + 0.25, row + 0.5]) + rng.uniform(-0.16, 0.16, 2)) * step
            inks = [_INKS[i] for i in rng.permutation(len(_INKS))[:2]]
            radius = step * rng.uniform(0.36, 0.54)
            kind, turn = int(rng.integers(4)), rng.uniform(0, 2 * np.pi)
            if kind == 3:
                _fill(pattern, _star(4, radius * 1.1, 0.32, turn) + centre, inks[0])
                _fill(pattern, _polygon(4, radius * 0.28, turn) + centre, _PAPER)
            else:
                _fill(pattern, _polygon(3 + kind, radius, turn) + centre, inks[0])
                _fill(pattern, _polygon(3 + kind, radius * 0.62, turn + rng.uniform(0.3, 1.0)) + centre, _PAPER)
                _fill(pattern, _polygon(4, radius * 0.32, rng.uniform(0, np.pi)) + centre, inks[1])
            _fill(pattern, _polygon(4, step * 0.07, turn) + centre + step * np.array([0.5, 0.46]), inks[1])
    return cv2.GaussianBlur(pattern, (0, 0), 0.8)


def _polygon(corners: int, radius: float, turn: float) -> np.ndarray:
    angle = turn + 2 * np.pi * np.arange(corners) / corners
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _star(points: int, radius: float, waist: float, turn: float) -> np.ndarray:
    outline = _polygon(2 * points, radius, turn)
    outline[1::2] *= waist
    return outline


def _fill(image: np.ndarray, outline: np.ndarray, colour: tuple[int, int, int]) -> None:
    cv2.fillPoly(image, [np.round(outline * 2**_SHIFT).astype(np.int32)], colour, cv2.LINE_AA, _SHIFT)
