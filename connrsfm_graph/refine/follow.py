"""Further views, one by one: the lengths of a finished fit are held, so that a view depends on nothing but itself.

Some tens of views tell the lengths of a surface as well as thousands would. The others of a long sequence then need no
joint solution: each starts from the surface of a fitted view that looks like it and moves to the minimum of its own
cost. This is what makes the work linear in the views, in any order and in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from connrsfm_graph.refine.arcs import ArcSplines
from connrsfm_graph.refine.config import RefineConfig
from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag
from connrsfm_graph.refine.reseat import reseat
from connrsfm_graph.refine.resection import moved_rigidly
from connrsfm_graph.refine.restarts import inverted, restart
from connrsfm_graph.refine.solve import fit_views, minimise
from connrsfm_graph.refine.task import Fit
from connrsfm_graph.refine.uncertainty import log_depth_deviation, pull
from connrsfm_graph.refine.unseen import Template, complete_images
from connrsfm_graph.refine.wrong_tracks import wrong_tracks

_ATTEMPTS = 3
"""Fits of a view without the tracks that the one before has shown to be wrong."""
_CAUGHT = (3.0, 0.02)
"""A view that costs so many times the median fitted view, and so much per edge, may be caught in a wrong shape."""
_TOLERANCE = 0.01
"""A view's fit ends where an iteration gains less than this part."""
_HELD = 1e6
"""Inverse standard deviation of log lengths that are known, while strains are found."""


@dataclass(frozen=True)
class Reference:
    """A finished fit of K views, as further views need it."""

    fit: Fit
    """The fit, over the points in use."""
    template: Template
    """These points on one plane."""
    seen: np.ndarray
    """(K, P') bool, observations that the fit trusts."""
    used: np.ndarray
    """(P,) bool, the points in use."""

    def typical_cost(self) -> float:
        """Median cost of a view."""
        measurements, shape = self.fit.measurements, self.fit.shape
        return float(np.median(costs(measurements, shape, lag(measurements, shape))))

    @cached_property
    def lengths_pull(self) -> np.ndarray:
        """(E,) by how much the prior on slants moves the log lengths, see `uncertainty.pull`."""
        return pull(self.fit.doubted(self.fit.measurements), self.fit.shape)[1]

    def gross(self) -> float:
        """Length beyond which a ray correction means a wrong track."""
        return self.fit.noise.gross(np.linalg.norm(self.fit.shape.correction, axis=-1)[self.seen])

    def all_points(self, values: np.ndarray) -> np.ndarray:
        """(B, P, ...) from values at the points in use, NaN elsewhere."""
        full = np.full((len(values), len(self.used), *values.shape[2:]), np.nan)
        full[:, self.used] = values
        return full


@dataclass(frozen=True)
class Followed:
    """B further views."""

    points: np.ndarray
    """(B, P, 3) camera frame of each view, in the scale of the fit; NaN where a point is not in use."""
    log_depth: np.ndarray
    """(B, P)."""
    depth_std: np.ndarray
    """(B, P) standard deviation of depth, in the unit of depth; NaN where not computed."""
    log_factor: np.ndarray
    """(B, P) log conformal factor, zero in an isometric model."""
    outlier: np.ndarray
    """(B, P) bool, observed but judged a wrong track."""
    ambiguous: np.ndarray
    """(B,) int, the group of the view followed (see `Refined.ambiguous`)."""
    alternative: np.ndarray | None
    """(B, P, 3) the points with ambiguous views inverted about the camera centre; None where no view is ambiguous."""


def follow(
    reference: Reference, image: np.ndarray, visible: np.ndarray, nearest: np.ndarray, config: RefineConfig
) -> Followed:
    """Fit further views to the lengths of a finished fit.

    Args:
        reference: the finished fit.
        image: (B, P, 2) normalised coordinates, any value where not visible.
        visible: (B, P) bool; every view sees points in use.
        nearest: (B,) index among the fitted views of the one where each view starts.
        config: settings of the fit.
    """
    used, fit = reference.used, reference.fit
    visible = visible[:, used]
    image = np.where(visible[..., None], image[:, used], 0.0)
    outlier = np.zeros_like(visible)
    if config.outliers:
        outlier = wrong_tracks(image, visible, (fit.measurements.image, reference.seen))
    measurements, shape = _fitted(reference, image, visible & ~outlier, nearest, config)
    for _ in range(_ATTEMPTS - 1):
        late = contradicted(shape.correction, visible & ~outlier, reference.gross())
        again = np.flatnonzero(late.any(axis=1))
        if not config.outliers or len(again) == 0:
            break
        outlier |= late
        part = _fitted(reference, image[again], (visible & ~outlier)[again], nearest[again], config)
        measurements, shape = measurements.replaced(again, part[0]), shape.replaced(again, part[1])
    deviation = np.full(visible.shape, np.nan)
    if config.uncertainty:
        deviation = log_depth_deviation(fit.doubted(measurements), shape, not fit.noisy, reference.lengths_pull)
    group = np.zeros(len(visible), dtype=int) if fit.ambiguity is None else fit.ambiguity.group[nearest]
    alternative = None
    if fit.alternative is not None:
        alternative = reference.all_points(inverted(shape, measurements.image, group > 0).points(measurements.image))
    wrong = np.zeros((len(visible), len(used)), dtype=bool)
    wrong[:, used] = outlier
    return Followed(
        points=reference.all_points(shape.points(measurements.image)),
        log_depth=reference.all_points(shape.log_depth),
        depth_std=reference.all_points(deviation * np.exp(shape.log_depth)),
        log_factor=reference.all_points(shape.log_factor if fit.conformal else np.zeros_like(shape.log_depth)),
        outlier=wrong,
        ambiguous=group,
        alternative=alternative,
    )


def contradicted(correction: np.ndarray, seen: np.ndarray, gross: float) -> np.ndarray:
    """(F, P) bool, seen points whose ray correction (F, P, 2) is beyond all noise."""
    return seen & (np.linalg.norm(correction, axis=-1) > gross)


def _fitted(
    reference: Reference, image: np.ndarray, seen: np.ndarray, nearest: np.ndarray, config: RefineConfig
) -> tuple[Measurements, Shape]:
    """Measurements of views that see the trusted points `seen`, and the shape that fits them."""
    fit = reference.fit
    image, deviation = complete_images(image, seen, reference.template)
    held = fit.shape.views(nearest)
    surface = moved_rigidly(fit.shape.points(fit.measurements.image)[nearest], image, seen)
    start = replace(held, log_depth=np.log(surface[..., 2]), correction=np.zeros_like(image))
    E = len(fit.measurements.mesh.edges)
    measurements = Measurements(
        image=image,
        image_weight=fit.noise.image_weight(seen, deviation),
        log_depth=start.log_depth,
        log_length=start.log_length,
        log_length_weight=fit.measurements.log_length_weight,
        length_weight=fit.measurements.length_weight[nearest],
        factor_weight=fit.measurements.factor_weight[nearest],
        strain_weight=fit.measurements.strain_weight,
        mesh=fit.measurements.mesh,
        frontal=fit.measurements.frontal,
        weights=fit.measurements.weights,
        arcs=None if fit.measurements.arcs is None else ArcSplines.over(image),
    )
    shape, cost = fit_views(measurements, start, config.iterations, _TOLERANCE)
    factor, per_edge = _CAUGHT
    caught = np.flatnonzero(cost > max(factor * reference.typical_cost(), per_edge * E))
    if len(caught):
        better, _ = restart(measurements.views(caught), shape.views(caught))
        if not better.log_factor.size:
            better, _ = reseat(measurements.views(caught), better)
        shape = shape.replaced(caught, better)
    if shape.strain.size:
        held_lengths = replace(measurements, log_length_weight=np.full(E, _HELD))
        shape, _ = minimise(held_lengths, shape, config.iterations, _TOLERANCE)
    return measurements, shape
