"""Other starts for single views: the way out of a wrong relief or tilt.

Once most views are right, so are the lengths; a view that is caught elsewhere then costs visibly more than it need.
With the lengths held, every view is fitted from a number of simple surfaces and keeps the cheapest.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from connrsfm_graph.refine.solve import Measurements, Shape, costs, fit_views, lag
from connrsfm_graph.refine.start import log_chords

_ITERATIONS = 25
_TOLERANCE = 0.02
"""A view's fit from a new surface ends where an iteration gains less than this part."""
_BETTER = 0.9
"""A new surface must lower the view's cost to this part."""
_TILTS = 6
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
    return Shape(
        log_depth=np.where(flip, shape.log_depth - squared + shift, shape.log_depth),
        correction=shape.correction,
        log_factor=np.where(flip, shape.log_factor - squared + shift, shape.log_factor),
        log_length=shape.log_length,
    )


def restart(measurements: Measurements, shape: Shape) -> tuple[Shape, np.ndarray]:
    """The shape with every view's cheapest surface, lengths held, and (F,) which views have a new one."""
    least = costs(measurements, shape, lag(measurements, shape))
    best, renewed = shape, np.zeros(len(least), dtype=bool)
    for start in _starts(measurements, shape):
        trial, cost = fit_views(measurements, _scaled(measurements, start), _ITERATIONS, _TOLERANCE)
        better = cost < _BETTER * least
        best, least, renewed = best.with_views(better, trial), np.where(better, cost, least), renewed | better
    return best, renewed


def _starts(measurements: Measurements, shape: Shape) -> Iterator[Shape]:
    """The shape's tangent planes, its mirror images in depth, its inversion and planes tilted in all directions."""
    F, P = shape.log_depth.shape
    ray = measurements.image + shape.correction
    centred = ray - ray.mean(axis=1, keepdims=True)
    spread = np.sqrt((centred**2).sum(axis=2).mean(axis=1))[:, None]
    rows = np.concatenate([np.ones((F, P, 1)), centred], axis=2)
    plane = np.einsum("fpk,fkq,fq->fp", rows, np.linalg.pinv(rows), shape.log_depth)
    mean = shape.log_depth.mean(axis=1, keepdims=True)
    relief = shape.log_depth - plane
    for log_depth in (plane, plane - relief, 2.0 * mean - plane + relief, 2.0 * mean - shape.log_depth):
        yield Shape(log_depth, shape.correction, shape.log_factor, shape.log_length)
    if shape.log_factor.size:
        yield inverted(shape, measurements.image, np.ones(F, dtype=bool))
    flat = np.zeros_like(shape.log_factor)
    for angle in np.arange(_TILTS) * (2.0 * np.pi / _TILTS):
        tilt = _STEEP * (centred @ np.array([np.cos(angle), np.sin(angle)])) / spread
        yield Shape(mean + tilt, shape.correction, flat, shape.log_length)


def _scaled(measurements: Measurements, shape: Shape) -> Shape:
    """Every view scaled so that the median of its length residuals is zero."""
    edges = measurements.mesh.edges
    residual = log_chords(shape.points(measurements.image), edges) - shape.log_length
    if shape.log_factor.size:
        residual -= 0.5 * (shape.log_factor[:, edges[:, 0]] + shape.log_factor[:, edges[:, 1]])
    shift = np.median(residual, axis=1, keepdims=True)
    return Shape(shape.log_depth - shift, shape.correction, shape.log_factor, shape.log_length)
