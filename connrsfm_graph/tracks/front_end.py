"""The whole way from images to tracks fit for a reconstruction.

images -> followed points -> lens undistorted -> keyframes -> wrong tracks dropped
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.check import MIN_FRAMES
from connrsfm_graph.tracks.config import TrackingConfig
from connrsfm_graph.tracks.follow import track_images
from connrsfm_graph.tracks.images import Source
from connrsfm_graph.tracks.keyframes import keyframes
from connrsfm_graph.tracks.lens import undistort_pixels
from connrsfm_graph.tracks.tracks import Tracks
from connrsfm_graph.tracks.wrong import wrong_tracks


@dataclass(frozen=True)
class Tracked:
    """Tracks and what was done to get them."""

    tracks: Tracks
    """The tracks that are left, in an ideal pinhole camera."""
    wrong: int
    """How many were dropped because they contradict the warps of the others."""


def images_to_tracks(
    source: Source,
    intrinsics: np.ndarray,
    config: TrackingConfig | None = None,
    masks: Source | None = None,
    distortion: np.ndarray | None = None,
    n_keyframes: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Tracked:
    """Follow points through images and keep what a reconstruction can use.

    Args:
        source, intrinsics, config, masks, progress: as in `follow.track_images`.
        distortion: (4,) or (5,) lens parameters (see `lens`); points are followed in the images as they are and then
            moved to where a camera without distortion would have seen them.
        n_keyframes: how many images to keep, chosen evenly by motion; all where None.

    Raises:
        InputError: what `track_images`, `undistort_pixels` and `keyframes` raise.
    """
    if n_keyframes is not None and n_keyframes < MIN_FRAMES:
        raise InputError(f"{n_keyframes} keyframes asked for, expected at least {MIN_FRAMES}")
    tracks = track_images(source, intrinsics, config, masks, progress)
    if distortion is not None:
        pixels = undistort_pixels(tracks.pixels, intrinsics, distortion)
        tracks = Tracks.checked(pixels, intrinsics, image_names=tracks.image_names, source="undistorted tracks")
    if n_keyframes is not None:
        tracks = tracks.select(frames=keyframes(tracks, n_keyframes).tolist())
        tracks = tracks.select(points=np.flatnonzero(tracks.visible.sum(axis=0) >= 2).tolist())
    wrong = wrong_tracks(tracks)
    return Tracked(tracks.select(points=np.flatnonzero(~wrong).tolist()), int(wrong.sum()))
