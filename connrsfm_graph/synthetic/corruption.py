"""Ways to spoil tracks: image noise, missing observations, gross errors. The truth in the tracks stays untouched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.tracks import Tracks


def with_noise(tracks: Tracks, pixels: float, seed: int = 0) -> Tracks:
    """Gaussian noise of standard deviation `pixels` on both coordinates of every observation."""
    noise = np.random.default_rng(seed).normal(scale=pixels, size=tracks.pixels.shape)
    return replace(tracks, pixels=tracks.pixels + noise)


def with_missing(tracks: Tracks, fraction: float, seed: int = 0) -> Tracks:
    """A fraction of the observations, chosen at random over all images and points, is no longer visible."""
    hidden = _chosen(tracks.visible, fraction, np.random.default_rng(seed))
    return replace(tracks, visible=tracks.visible & ~hidden, pixels=np.where(hidden[..., None], np.nan, tracks.pixels))


def with_outliers(tracks: Tracks, fraction: float, seed: int = 0) -> tuple[Tracks, np.ndarray]:
    """A fraction of the observations is displaced in a random direction by 10 to 50 % of the image's track extent.

    The extent is the longer side of the bounding box of the image's observations.

    Returns:
        The tracks and (F, P) bool, which observations are wrong.
    """
    rng = np.random.default_rng(seed)
    wrong = _chosen(tracks.visible, fraction, rng)
    extent = np.array([np.ptp(xy[seen], axis=0).max() for xy, seen in zip(tracks.pixels, tracks.visible, strict=True)])
    length = rng.uniform(0.1, 0.5, wrong.shape) * extent[:, None]
    angle = rng.uniform(0.0, 2 * np.pi, wrong.shape)
    shift = length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return replace(tracks, pixels=tracks.pixels + np.where(wrong[..., None], shift, 0.0)), wrong


def _chosen(visible: np.ndarray, fraction: float, rng: np.random.Generator) -> np.ndarray:
    """(F, P) bool with the given fraction of the visible entries set, to the nearest whole number."""
    if not 0.0 <= fraction <= 1.0:
        raise InputError(f"the fraction of observations must lie between 0 and 1, got {fraction}")
    entries = np.flatnonzero(visible)
    chosen = np.zeros(visible.shape, dtype=bool)
    chosen.flat[rng.choice(entries, round(fraction * len(entries)), replace=False)] = True
    return chosen
