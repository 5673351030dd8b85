"""Single points put where their lengths agree, along their sight rays.

A ray meets the sphere about a neighbour twice. A point with few neighbours, at a corner of the surface, may be caught
at the wrong one while the rest of the view is right; its lengths then disagree with each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from connrsfm_graph.refine.solve import Measurements, Shape, lag

_STEPS = np.linspace(-0.3, 0.3, 61)
"""Changes of log depth that are tried."""
_BETTER = 0.8
"""A new place must lower the cost of the point's lengths to this part; the fit from there decides."""


def reseated(measurements: Measurements, shape: Shape) -> Shape:
    """An isometric shape with some points moved along their rays, each where the lengths to its neighbours cost least.

    Of neighbours that would all gain by moving only the one that gains most does, since its wrong place makes those of
    the others look wrong.
    """
    edges = measurements.mesh.edges
    point, other = np.concatenate([edges, edges[:, ::-1]]).T  # every edge from either end
    wanted = np.tile(shape.log_length - lag(measurements, shape).offset, 2)
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
