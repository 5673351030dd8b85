"""Global refinement: all views together, up to what the surface can do, with the noise of the images in view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.refine.config import RefineConfig
from connrsfm_graph.refine.doubts import doubts
from connrsfm_graph.refine.fit import fit
from connrsfm_graph.refine.follow import Reference, contradicted
from connrsfm_graph.refine.settle import without
from connrsfm_graph.refine.task import Task
from connrsfm_graph.refine.uncertainty import log_depth_deviation
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.refine.wrong_tracks import wrong_tracks

_ATTEMPTS = 3
"""Fits without the tracks that the one before has shown to be wrong."""
_FEW = 0.002
"""Where no larger part of the observations is shown to be wrong, what a fit has decided is not decided anew."""


@dataclass(frozen=True)
class Refined:
    """The refined surfaces and the evidence for how they were refined."""

    points: np.ndarray
    """(F, P, 3) camera frame of each view; also where a point was not seen. NaN where it was seen in no view."""
    log_depth: np.ndarray
    """(F, P)."""
    depth_std: np.ndarray
    """(F, P) standard deviation of depth, in the unit of depth; NaN where not computed."""
    ray_correction: np.ndarray
    """(F, P, 2) correction of the tracked image point, normalised coordinates; NaN where not seen."""
    log_factor: np.ndarray
    """(F, P) log conformal factor, zero in an isometric model. Differences between views are the log conformal scale of
    the map from one to the other; the evidence names the assumption on which they rest."""
    log_length: np.ndarray
    """(E,) log lengths of the mesh's edges, shared by the views, mean zero."""
    mesh_edges: np.ndarray
    """(E, 2) points of each edge."""
    outlier: np.ndarray
    """(F, P) bool, observed but judged a wrong track; its point is recovered from the others."""
    model: Literal["isometric", "conformal"]
    """Which model was chosen."""
    ambiguous: np.ndarray
    """(F,) int, 0 for views that are decided, always so in an isometric model; those of the same positive number may be
    inverted about the camera centre, X -> X / |X|^2, but only all together."""
    alternative: np.ndarray | None
    """(F, P, 3) the points with all ambiguous views inverted; None where no view is ambiguous."""
    evidence: Mapping[str, Any]
    """What the choices rest on."""
    cost_history: tuple[float, ...]
    """Cost at the start and after every iteration; starts anew where the assumed noise or the start changed."""
    reference: Reference
    """What further views need to follow these."""
    warnings: tuple[str, ...] = ()
    """One sentence each."""


def refine(
    image: np.ndarray,
    visible: np.ndarray,
    log_depth: np.ndarray,
    config: RefineConfig,
    sigma_image: float,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """Refine the depths of all views.

    Args:
        image: (F, P, 2) normalised coordinates, any value where not visible.
        visible: (F, P) bool.
        log_depth: (F, P) where to start, in any scale per view; NaN is interpolated from the other points of the view.
        config: settings.
        sigma_image: standard deviation of a coordinate of the image points, normalised; NaN where it is not known.
        progress: called with (done, total).

    Raises:
        InputError: arrays do not fit, or a view has nothing to start from.
    """
    image, visible, log_depth = _checked(image, visible, log_depth, config)
    outlier = wrong_tracks(image, visible) if config.outliers else np.zeros_like(visible)
    late, found = np.zeros_like(visible), None
    for attempt in range(_ATTEMPTS):
        if progress is not None:
            progress(attempt, _ATTEMPTS)
        used = (visible & ~outlier).any(axis=0)
        seen = (visible & ~outlier)[:, used]
        completed = complete(image[:, used], seen, np.where(outlier, np.nan, log_depth)[:, used])
        task = Task.of(completed, seen, config)
        few = late.sum() <= _FEW * seen.sum() and not late[:, ~used].any()
        if found is None or found.conformal or not few:
            found = fit(task, sigma_image)
        else:
            found = without(task, found, late[:, used])
        late = np.zeros_like(visible)
        reference = Reference(found, completed.template, seen, used)
        late[:, used] = contradicted(found.shape.correction, seen, reference.gross())
        if not config.outliers or not late.any():
            break
        outlier |= late
    if progress is not None:
        progress(_ATTEMPTS, _ATTEMPTS)
    return _refined(reference, config, outlier)


def _checked(
    image: np.ndarray, visible: np.ndarray, log_depth: np.ndarray, config: RefineConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    image, log_depth = np.asarray(image, dtype=float), np.asarray(log_depth, dtype=float)
    visible = np.asarray(visible, dtype=bool)
    if image.shape != (*visible.shape, 2) or log_depth.shape != visible.shape:
        raise InputError(
            f"refinement: image {image.shape}, visible {visible.shape} and log_depth {log_depth.shape} do not fit, "
            "expected (F, P, 2), (F, P) and (F, P)"
        )
    if not np.isfinite(image[visible]).all():
        raise InputError("refinement: an image point is NaN where 'visible' is true")
    if not visible.any(axis=1).all():
        raise InputError(f"refinement: image {int(visible.any(axis=1).argmin())} sees no point")
    for view in config.isometric_views:
        if not 0 <= view < len(visible):
            raise InputError(f"refine.isometric_views names view {view}, expected 0 to {len(visible) - 1}")
    return np.where(visible[..., None], image, 0.0), visible, log_depth


def _refined(reference: Reference, config: RefineConfig, outlier: np.ndarray) -> Refined:
    found, seen, all_points = reference.fit, reference.seen, reference.all_points
    image, shape = found.measurements.image, found.shape
    deviation = np.full(seen.shape, np.nan)
    if config.uncertainty:
        deviation = log_depth_deviation(found.doubted(found.measurements), shape, stretch=not found.noisy)
    group = np.zeros(len(seen), dtype=int) if found.ambiguity is None else found.ambiguity.group
    return Refined(
        points=all_points(shape.points(image)),
        log_depth=all_points(shape.log_depth),
        depth_std=all_points(deviation * np.exp(shape.log_depth)),
        ray_correction=all_points(np.where(seen[..., None], shape.correction, np.nan)),
        log_factor=all_points(shape.log_factor if found.conformal else np.zeros_like(shape.log_depth)),
        log_length=shape.log_length,
        mesh_edges=np.flatnonzero(reference.used)[found.measurements.mesh.edges],
        outlier=outlier,
        model="conformal" if found.conformal else "isometric",
        ambiguous=group,
        alternative=None if found.alternative is None else all_points(found.alternative.points(image)),
        evidence=found.evidence,
        cost_history=tuple(found.history),
        reference=reference,
        warnings=tuple(doubts(found, seen)),
    )
