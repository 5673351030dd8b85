"""Other starts for single views: the way out of a wrong relief or tilt.

Once most views are right, so are the lengths; a view that is caught elsewhere then costs visibly more than it need.
With the lengths held, every view is fitted from a number of simple surfaces and keeps the cheapest. All are fitted
for a few iterations, only the most promising ones to the end. What other views have found to be the surface is
another start, moved rigidly to where it is seen.

Seen from afar, a bent sheet may be wrong in a part: of two bends each can be taken for its mirror image in depth.
So isometric views are also tried with the part on one side of a line reflected about it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag
from connrsfm_graph.refine.resection import moved_rigidly
from connrsfm_graph.refine.solve import fit_views
from connrsfm_graph.refine.start import log_chords
from connrsfm_graph.refine.stretch import stretches

_ITERATIONS = 25
_TOLERANCE = 0.02
"""A view's fit from a new surface ends where an iteration gains less than this part."""
_BETTER = 0.9
"""A new surface must lower the view's cost to this part."""
_TILTS = 6
_FOLDS = (6, 3)
"""Directions of the lines about which a part of a view is reflected, and lines in each."""
_STRIP = 0.1
"""Half-width of the strip whose depth makes such a line, over the extent of the image across it."""
_SCREENING = 1
"""Iterations after which the starts are compared."""
_TRIED = (12, 4.0)
"""So many of the cheapest starts are then followed to the end, where they cost at most this many times the shape.
With conformal factors, which are slow to come, all are."""
_LENT = 6
"""Surfaces of other views that a view starts from, those that project best to its image points."""
_STEEP = 0.15
"""Change of log depth over the spread of the image points in a tilted start."""


def inverted(shape: Shape, image: np.ndarray, views: np.ndarray) -> Shape:
    """The shape with some views inverted about the camera centre, X -> X / |X|^2, which no image residual can tell.

    The inversion is conformal: chords become |x - y| / (|x| |y|), so the log conformal factor changes by -2 log |X|.

    Args:
        shape: conformal shape.
        image: (F, P, 2) tracked image points.
        views: (F,) bool, views to invert; each is rescaled to keep its mean log conformal factor.
    """
    squared = 2.0 * np.log(np.linalg.norm(shape.points(image), axis=-1))
    shift = squared.mean(axis=1, keepdims=True)
    flip = views[:, None]
    return replace(
        shape,
        log_depth=np.where(flip, shape.log_depth - squared + shift, shape.log_depth),
        log_factor=np.where(flip, shape.log_factor - squared + shift, shape.log_factor),
    )


def restart(measurements: Measurements, shape: Shape, others: np.ndarray | None = None) -> tuple[Shape, np.ndarray]:
    """The shape with every view's cheapest surface, lengths held, and (F,) which views have a new one.

    Args:
        measurements, shape: the views.
        others: (K, P, 3) surfaces of other views, in front of their cameras, to start from as well.
    """
    least = costs(measurements, shape, lag(measurements, shape))
    lent = [] if others is None else list(_lent(measurements, shape, others))
    first = np.stack(
        [
            fit_views(measurements, _scaled(measurements, start), _SCREENING, 0.0)[1]
            for start in chain(_starts(measurements, shape), lent)
        ]
    )
    number, factor = _TRIED
    tried = (np.argsort(np.argsort(first, axis=0), axis=0) < number) & (first <= factor * least)
    tried |= shape.log_factor.size > 0
    best, renewed = shape, np.zeros(len(least), dtype=bool)
    for start, chosen in zip(chain(_starts(measurements, shape), lent), tried, strict=True):
        if not chosen.any():
            continue
        views = np.flatnonzero(chosen)
        part = measurements.views(views)
        trial, cost = fit_views(part, _scaled(part, start.views(views)), _ITERATIONS, _TOLERANCE)
        better = cost < _BETTER * least[views]
        views = views[better]
        best = best.replaced(views, trial.views(better))
        least[views], renewed[views] = cost[better], True
    return best, renewed


def _starts(measurements: Measurements, shape: Shape) -> Iterator[Shape]:
    """The shape's tangent planes, its mirror images in depth, as a whole and in part, or its inversion, and planes
    tilted in all directions."""
    F, P = shape.log_depth.shape
    ray = measurements.image + shape.correction
    centred = ray - ray.mean(axis=1, keepdims=True)
    spread = np.sqrt((centred**2).sum(axis=2).mean(axis=1))[:, None]
    rows = np.concatenate([np.ones((F, P, 1)), centred], axis=2)
    plane = np.einsum("fpk,fkq,fq->fp", rows, np.linalg.pinv(rows), shape.log_depth)
    mean = shape.log_depth.mean(axis=1, keepdims=True)
    relief = shape.log_depth - plane
    for log_depth in (plane, plane - relief, 2.0 * mean - plane + relief, 2.0 * mean - shape.log_depth):
        yield replace(shape, log_depth=log_depth)
    if shape.log_factor.size:
        yield inverted(shape, measurements.image, np.ones(F, dtype=bool))
    else:
        yield from _folded(shape, centred)
    flat = np.zeros_like(shape.log_factor)
    for angle in np.arange(_TILTS) * (2.0 * np.pi / _TILTS):
        tilt = _STEEP * (centred @ np.array([np.cos(angle), np.sin(angle)])) / spread
        yield replace(shape, log_depth=mean + tilt, log_factor=flat)


def _lent(measurements: Measurements, shape: Shape, others: np.ndarray) -> Iterator[Shape]:
    """Surfaces of other views (K, P, 3), moved rigidly to the image points; best projections first."""
    image = measurements.image
    F, P, _ = image.shape
    every = np.ones((F, P), dtype=bool)
    moved = np.stack([moved_rigidly(np.repeat(surface[None], F, axis=0), image, every) for surface in others])
    error = ((moved[..., :2] / moved[..., 2:] - image) ** 2).sum(axis=(2, 3))
    for number in np.argsort(error, axis=0, kind="stable")[:_LENT]:
        yield replace(shape, log_depth=np.log(moved[number, np.arange(F), :, 2]))


def _folded(shape: Shape, ray: np.ndarray) -> Iterator[Shape]:
    """The shape with the part on one side of a line in the image (rays (F, P, 2), centred) reflected about the line.

    The line's depth is linear along it, from the points near it.
    """
    directions, lines = _FOLDS
    for angle in np.arange(directions) * (np.pi / directions):
        across, along = ray @ np.array([np.cos(angle), np.sin(angle)]), ray @ np.array([-np.sin(angle), np.cos(angle)])
        for share in np.arange(1, lines + 1) / (lines + 1):
            offset = across - np.quantile(across, share, axis=1, keepdims=True)
            near = np.exp(-0.5 * (offset / (_STRIP * np.ptp(across, axis=1, keepdims=True))) ** 2)
            near /= near.sum(axis=1, keepdims=True)
            middle, depth = ((near * values).sum(axis=1, keepdims=True) for values in (along, shape.log_depth))
            slope = (near * (along - middle) * (shape.log_depth - depth)).sum(axis=1, keepdims=True)
            slope /= np.maximum((near * (along - middle) ** 2).sum(axis=1, keepdims=True), 1e-300)
            reflected = 2.0 * (depth + slope * (along - middle)) - shape.log_depth
            for beyond in (offset > 0.0, offset < 0.0):
                log_depth = np.where(beyond, reflected, shape.log_depth)
                yield replace(shape, log_depth=log_depth)


def _scaled(measurements: Measurements, shape: Shape) -> Shape:
    """Every view scaled so that the median of its length residuals is zero."""
    edges = measurements.mesh.edges
    length = shape.log_length + stretches(shape.strain, measurements.mesh)[0]
    residual = log_chords(shape.points(measurements.image), edges) - length
    if shape.log_factor.size:
        residual -= 0.5 * (shape.log_factor[:, edges[:, 0]] + shape.log_factor[:, edges[:, 1]])
    shift = np.median(residual, axis=1, keepdims=True)
    return replace(shape, log_depth=shape.log_depth - shift)
