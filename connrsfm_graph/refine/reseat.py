"""Single points put where their lengths agree, along their sight rays.

A ray meets the sphere about a neighbour twice. A point with few neighbours, at a corner of the surface, may be caught
at the wrong one while the rest of the view is right; its lengths then disagree with each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag
from connrsfm_graph.refine.solve import fit_views
from connrsfm_graph.refine.stretch import stretches

_STEPS = np.linspace(-0.3, 0.3, 61)
"""Changes of log depth that are tried."""
_BETTER = 0.8
"""A new place must lower the cost of the point's lengths to this part; the fit from there decides."""
_WORTH = 0.9
"""That fit must lower the view's cost to this part."""
_ITERATIONS = 25
_TOLERANCE = 0.02
"""It ends where an iteration gains less than this part."""


def reseat(measurements: Measurements, shape: Shape) -> tuple[Shape, np.ndarray]:
    """The isometric shape with single points of a view elsewhere where that pays, lengths held, and (F,) in which
    views it did."""
    trial, cost = fit_views(measurements, reseated(measurements, shape), _ITERATIONS, _TOLERANCE)
    better = cost < _WORTH * costs(measurements, shape, lag(measurements, shape))
    return shape.replaced(np.flatnonzero(better), trial.views(better)), better


def reseated(measurements: Measurements, shape: Shape) -> Shape:
    """An isometric shape with some points moved along their rays, each where the lengths to its neighbours cost least.

    Of neighbours that would all gain by moving only the one that gains most does, since its wrong place makes those of
    the others look wrong.
    """
    edges = measurements.mesh.edges
    point, other = np.concatenate([edges, edges[:, ::-1]]).T  # every edge from either end
    stretch, _ = stretches(shape.strain, measurements.mesh)
    wanted = np.tile(shape.log_length + stretch - lag(measurements, shape).offset, 2)
    weight = np.tile(measurements.length_weight, 2)
    X = shape.points(measurements.image)
    of_point = sparse.csr_array((np.ones(len(point)), (np.arange(len(point)), point)), (len(point), X.shape[1]))

    def cost(step: float) -> np.ndarray:
        chord = np.linalg.norm(np.exp(step) * X[:, point] - X[:, other], axis=-1)
        residual = np.abs(weight * (np.log(np.maximum(chord, np.finfo(float).tiny)) - wanted))
        huber = measurements.weights.huber
        return np.where(residual <= huber, 0.5 * residual**2, huber * (residual - 0.5 * huber)) @ of_point

    now, tried = cost(0.0), np.stack([cost(step) for step in _STEPS])
    gain = now - tried.min(axis=0)
    gain[tried.min(axis=0) > _BETTER * now] = 0.0
    most = np.zeros_like(gain)  # of the neighbours
    np.maximum.at(most.T, point, gain.T[other])
    moved = np.where((gain > 0.0) & (gain >= most), _STEPS[tried.argmin(axis=0)], 0.0)
    return replace(shape, log_depth=shape.log_depth + moved)
