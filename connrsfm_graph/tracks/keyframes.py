"""A few images that stand for all: evenly spread over the motion in the images, not over time."""

from __future__ import annotations

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.check import MIN_FRAMES
from connrsfm_graph.tracks.tracks import Tracks


def keyframes(tracks: Tracks, number: int) -> np.ndarray:
    """Numbers (N,) of the images between which the points have moved about equally far, first and last included.

    The motion from image to image is the median distance that common points move in pixels; a pause in a video counts
    for little, a fast movement gets its images.

    Raises:
        InputError: fewer than three, or more than there are images.
    """
    n_frames = tracks.n_frames
    if not MIN_FRAMES <= number <= n_frames:
        raise InputError(f"{number} keyframes asked for, expected {MIN_FRAMES} to {n_frames}, the number of images")
    moved = np.linalg.norm(np.diff(tracks.pixels, axis=0), axis=2)
    known = np.isfinite(moved).any(axis=1)
    motion = np.zeros(n_frames - 1)
    motion[known] = np.nanmedian(moved[known], axis=1)
    motion[~known] = motion.max()  # a cut: at least as far as the farthest
    travelled = np.concatenate([[0.0], np.cumsum(motion + 1e-6)])
    wanted = np.linspace(0.0, travelled[-1], number)
    chosen = np.abs(travelled[:, None] - wanted).argmin(axis=0)
    # Two places of which one image is the nearest: the next free images are taken instead.
    low, high = np.arange(number), n_frames - number + np.arange(number)
    for i in range(1, number):
        chosen[i] = max(chosen[i], chosen[i - 1] + 1)
    return np.clip(chosen, low, high)
