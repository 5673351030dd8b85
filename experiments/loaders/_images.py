"""Image sequences with depth maps: points are tracked here, and the truth is the depth where each one is seen.

    images/      the sequence, any names that sort
    depth/       one map per image in the same order: .npy in any unit, or 16-bit .png; 0 or NaN where unknown
    K.txt        intrinsics
    masks/       optional, not black where the object is

A pixel's truth is read off the nearest entry of the depth map, so it is no better than the map's resolution.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks import Tracks, parse_intrinsics

DEPTH_KINDS = (".npy", ".png")


def load_images(folder: Path) -> Tracks:
    """Track the images of a folder in the layout above; without `depth/` the tracks have no truth.

    Raises:
        InputError: images or intrinsics are missing, or there is not one depth map per image.
    """
    from connrsfm_graph.tracks.front_end import images_to_tracks

    masks = folder / "masks"
    tracks = images_to_tracks(
        folder / "images", parse_intrinsics(folder / "K.txt"), masks=masks if masks.is_dir() else None
    ).tracks
    if not (folder / "depth").is_dir():
        return tracks
    maps = sorted(path for path in (folder / "depth").iterdir() if path.suffix in DEPTH_KINDS)
    if len(maps) != tracks.n_frames:
        raise InputError(f"{folder / 'depth'}: holds {len(maps)} maps for {tracks.n_frames} images, expected one each")
    depth = np.stack([_at_pixels(_read(path), pixels) for path, pixels in zip(maps, tracks.pixels, strict=True)])
    rays = np.concatenate([tracks.normalised(), np.ones((*depth.shape, 1))], axis=-1)
    return replace(tracks, points=rays * np.where(depth > 0, depth, np.nan)[..., None])


def _at_pixels(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(P,) depth at the nearest entries, NaN where a point is not visible or outside the map."""
    column, row = np.round(np.where(np.isfinite(pixels), pixels, -1.0)).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    found = np.full(len(pixels), np.nan)
    found[inside] = depth[row[inside], column[inside]]
    return found


def _read(path: Path) -> np.ndarray:
    if path.suffix == ".npy":
        depth = np.load(path, allow_pickle=False)
    else:
        import cv2

        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.ndim != 2:
        raise InputError(f"{path}: not a depth map, expected one number per pixel")
    return depth.astype(float)
