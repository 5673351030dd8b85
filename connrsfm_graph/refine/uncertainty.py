"""How sure the depths are: the noise of image points and lengths, propagated through the linearised problem.

Noise as the fit assumes it is drawn at random and the linear problem solved; the spread of the solutions is the
deviation asked for (the covariance of all depths is far too large to be formed). It holds for the model: depths of
one scale common to all views, lengths that are the same in all views up to noise. Where the ray corrections have
shown that the surface stretches (see `noise`), the lengths' noise is drawn alike for neighbours, which bends and
tilts surfaces much more than independent noise of the same size.
"""

from __future__ import annotations

import numpy as np

from connrsfm_graph.refine.elimination import Factorised
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.solve import Measurements, Shape, lag, linearise

_SAMPLES = 20
_TOLERANCE = 0.03
"""Relative accuracy of the linear solutions, well below that of a deviation from so few draws."""
_SMOOTHINGS = 4
"""Averages over neighbours that make independent noise a stretch of the surface."""


def log_depth_deviation(
    measurements: Measurements, shape: Shape, stretch: bool, jointly: bool = True, seed: int = 0
) -> np.ndarray:
    """(F, P) standard deviation of log depth, the scale common to all views left out.

    Args:
        measurements: with the noise levels of the fit.
        shape: minimum of the cost.
        stretch: whether lengths vary alike for neighbours.
        jointly: whether the views were fitted together with the lengths. Else the lengths are taken as known, views do
            not depend on each other, and all have the same draws.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    F, P = shape.log_depth.shape
    envelope = measurements.envelope(shape.log_factor.size > 0)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    factorised = Factorised(equations, envelope, measurements.mesh.edges)
    rays = envelope.unknown[:, None] + np.array([1, 2])
    drawn, solutions = F if jointly else 1, []
    for _ in range(_SAMPLES):
        noise = _length_noise(rng, drawn, measurements, stretch)
        gradient = -factorised.spread(noise)
        gradient[:, rays] += measurements.image_weight[..., None] * rng.standard_normal((drawn, P, 2))
        if jointly:
            gradient, _ = factorised.solve(gradient, -(equations.weight * noise).sum(axis=0), _TOLERANCE)
        solutions.append(gradient)
    views = np.stack(solutions, axis=-1)
    if not jointly:
        views = factorised.solve_views(views)
    # Variances vary slowly over the surface, their estimates from a few draws do not.
    return np.asarray(np.sqrt(_around((views[:, envelope.unknown] ** 2).mean(axis=-1), measurements.mesh)))


def _length_noise(rng: np.random.Generator, drawn: int, measurements: Measurements, stretch: bool) -> np.ndarray:
    """(F, E) errors of the log lengths, drawn for all views or, drawn = 1, the same in each."""
    edges = measurements.mesh.edges
    if not stretch:
        return np.asarray(rng.standard_normal((drawn, len(edges))) / measurements.length_weight)
    field = rng.standard_normal((drawn, measurements.mesh.n_points))
    for _ in range(_SMOOTHINGS):
        field = _around(field, measurements.mesh)
    field /= field.std()
    return np.asarray(0.5 * (field[:, edges[:, 0]] + field[:, edges[:, 1]]) / measurements.length_weight)


def _around(values: np.ndarray, mesh: Mesh) -> np.ndarray:
    """(F, P) means over every point and its near neighbours."""
    total, count = values.copy(), np.ones(mesh.n_points)
    near = mesh.edges[: mesh.n_near]
    for a, b in ((0, 1), (1, 0)):
        np.add.at(total.T, near[:, a], values.T[near[:, b]])
        np.add.at(count, near[:, a], 1.0)
    return np.asarray(total / count)
