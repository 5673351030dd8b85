"""A hanging cloth, 50 images with a point cloud of a depth camera each; points are tracked here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import read_npz
from connrsfm_graph.tracks import Tracks, parse_intrinsics
from connrsfm_graph.tracks.front_end import images_to_tracks
from experiments.loaders import Dataset

FRAMES = 10
"""Images that are reconstructed, evenly spaced."""
_NEAREST = 2.0
"""Pixels beyond which no point of the cloud says how far a tracked point is."""


def load_cloth(folder: Path) -> Tracks:
    """Follow points through all images of a folder and take ten evenly spaced ones, with their truth.

    The clouds have no correspondences: a track's truth lies on its sight ray at the depth of the cloud's point that
    projects nearest to it.

    Raises:
        InputError: a file is missing or damaged, or there is not one cloud per image.
    """
    tracks = images_to_tracks(folder / "images", parse_intrinsics(folder / "K.txt")).tracks
    clouds = read_npz(folder / "truth_clouds.npz")
    if missing := {"points", "offset", "K"} - set(clouds):
        raise InputError(f"{folder / 'truth_clouds.npz'}: field '{min(missing)}' is missing")
    if len(clouds["offset"]) != tracks.n_frames + 1:
        raise InputError(
            f"{folder / 'truth_clouds.npz'}: holds {len(clouds['offset']) - 1} clouds for {tracks.n_frames} images"
        )
    chosen = np.linspace(0, tracks.n_frames - 1, min(FRAMES, tracks.n_frames)).round().astype(int)
    tracks = tracks.select(frames=chosen.tolist())
    tracks = tracks.select(points=np.flatnonzero(tracks.visible.sum(axis=0) >= 2).tolist())
    parts = [clouds["points"][slice(*clouds["offset"][f : f + 2])].astype(float) for f in chosen]
    depth = np.stack(
        [_nearest_depth(cloud, clouds["K"], pixels) for cloud, pixels in zip(parts, tracks.pixels, strict=True)]
    )
    rays = np.concatenate([tracks.normalised(), np.ones((*depth.shape, 1))], axis=-1)
    return replace(tracks, points=rays * depth[..., None])


def _nearest_depth(cloud: np.ndarray, K: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(P,) depth of the points of a cloud (N, 3) that project nearest to pixels (P, 2), NaN where none is near."""
    projected = cloud @ K.T
    depth = np.full(len(pixels), np.nan)
    (seen,) = np.nonzero(np.isfinite(pixels).all(axis=1))
    distance, nearest = cKDTree(projected[:, :2] / projected[:, 2:]).query(pixels[seen])
    near = distance < _NEAREST
    depth[seen[near]] = cloud[nearest[near], 2]
    return depth


DATASET = Dataset(
    "hanging cloth R1, 50 images of 960 x 540 with point clouds",
    "phi-SfT (Kairanda et al., CVPR 2022), as cut by github.com/DavidStotko/Physics-guided-Shape-from-Template",
    "images/, K.txt and truth_clouds.npz with K, points (sum, 3) and offset: cloud f is points[offset[f]:offset[f+1]]",
    load_cloth,
)
