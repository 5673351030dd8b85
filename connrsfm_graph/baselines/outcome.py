"""From the depths that a baseline found to the reconstruction and the record that every method returns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord, package_versions, peak_memory_mib
from connrsfm_graph.surface_spline import terms_of_depth
from connrsfm_graph.tracks import Tracks
from factors.surface import PERSPECTIVE, normals

MIN_POINTS = 4
"""An image with fewer points of known depth has no surface: it counts as not recovered."""


def outcome(
    tracks: Tracks,
    log_depth: np.ndarray,
    method: str,
    settings: Mapping[str, Any],
    decisions: Mapping[str, Any],
    progress: Progress,
    interpolated: np.ndarray | None = None,
) -> tuple[Reconstruction, RunRecord]:
    """Surfaces through points of known depth, and the record of how they came about.

    Args:
        tracks: the input.
        log_depth: (F, P) log depth along z, NaN where not recovered.
        method: name of the baseline.
        settings, decisions: the settings it ran with, and what it found or chose from the data.
        progress: of the run, for the seconds per stage.
        interpolated: (F, P) bool, depth comes from the surface around the point; nowhere by default.

    Raises:
        ComputationError: no image has enough points of known depth.
    """
    image = np.nan_to_num(tracks.normalised())
    known = np.isfinite(log_depth) & tracks.visible
    known &= known.sum(axis=1, keepdims=True) >= MIN_POINTS
    if not known.any():
        raise ComputationError(f"{method} recovers no image: none has {MIN_POINTS} points that it can relate to others")
    log_depth = np.where(known, log_depth, 0.0)
    frames = known.any(axis=1)
    first, second = np.zeros((*known.shape, 2)), np.zeros((*known.shape, 3))
    first[frames], second[frames], _ = terms_of_depth(image[frames], log_depth[frames], known[frames], PERSPECTIVE)
    seen = known[..., None]
    points = np.where(seen, PERSPECTIVE.points(image, np.exp(log_depth)), np.nan)
    nothing = np.full(known.shape, np.nan)
    reconstruction = Reconstruction(
        pixels=tracks.pixels,
        K=tracks.K,
        visible=tracks.visible,
        points=points,
        normals=np.where(seen, normals(image, first), np.nan),
        depth=points[..., 2],
        first_order=np.where(seen, first, np.nan),
        second_order=np.where(seen, second, np.nan),
        edges=np.zeros((0, 2), dtype=int),
        edge_weight=np.zeros(0),
        conformal_scale=np.zeros((0, tracks.n_points)),
        depth_std=nothing,
        log_factor=nothing,
        interpolated=known & (np.zeros_like(known) if interpolated is None else interpolated),
        outlier=np.zeros_like(known),
        image_names=None if tracks.image_names is None else np.asarray(tracks.image_names),
    )
    lost = np.flatnonzero(~frames)
    warnings = (
        (f"{method} cannot recover images {', '.join(map(str, lost))}: too few shared tracks",) if len(lost) else ()
    )
    record = RunRecord(
        source="",
        method=method,
        seed=0,
        configuration=dict(settings),
        decisions=dict(decisions),
        warnings=warnings,
        seconds=dict(progress.seconds),
        peak_memory_mib=peak_memory_mib(),
        versions=package_versions(),
    )
    return reconstruction, record
