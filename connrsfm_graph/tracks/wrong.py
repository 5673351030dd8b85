"""Wrong tracks, found by what they leave of the warps between images.

A surface that bends moves smoothly in the images: the robust warp from one image to another, fitted to all tracks,
holds for each. A track that slipped to another point of the surface contradicts the warps between the images before
and after, again and again, while one contradiction alone may be a wrinkle. Short tracks are few and begin or end at
borders, where tracks slip along what covers the surface: of these one contradiction is enough.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.tracks.tracks import Tracks
from connrsfm_graph.warps import WarpConfig, fit_warps

_IMAGES = 10
"""Images between which warps are fitted, spread evenly; at most so many."""
_STRIDES = (1, 3)
"""How far apart, in these, the two images of a warp are."""
_CONTRADICTED = 0.25
"""Robust weight below which a track contradicts a warp: it misses by twice what is allowed for noise."""
_OFTEN = 0.2
"""A track that contradicts more than this share of its warps is wrong."""
_SEVERAL = 5
"""Of so many warps more than one must be contradicted."""


def wrong_tracks(tracks: Tracks) -> np.ndarray:
    """(P,) bool, the tracks that contradict the warps of the others."""
    chosen = np.unique(np.linspace(0, tracks.n_frames - 1, min(_IMAGES, tracks.n_frames)).round().astype(int))
    part = tracks.select(frames=chosen.tolist())
    edges = np.array([(a, a + s) for s in _STRIDES for a in range(len(chosen) - s)])
    warps = fit_warps(part.normalised(), part.visible, edges, WarpConfig(model="gaussian_process"))
    judged = warps.weight > 0
    against = (judged & (warps.weight < _CONTRADICTED)).sum(axis=0)
    of = judged.sum(axis=0)
    return np.asarray((against > _OFTEN * of) & ((against > 1) | (of < _SEVERAL)))
