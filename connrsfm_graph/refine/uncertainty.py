"""How sure the depths are: the noise of image points and lengths, propagated through the linearised problem.

Noise as the fit assumes it is drawn at random and the linear problem solved; the spread of the solutions is the
deviation asked for (the covariance of all depths is far too large to be formed). It holds for the model: depths of
one scale common to all views, lengths that are the same in all views up to noise. Where the ray corrections have
shown that the surface stretches (see `noise`), the lengths' noise is drawn alike for neighbours, which bends and
tilts surfaces much more than independent noise of the same size.

How strong the prior on slants is to be the data say roughly, to a factor of e perhaps. By how much depths would move
with it, the prior's pull, adds to their deviation: where tracks leave slants open, it is most of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
from numba import njit

from connrsfm_graph.refine.cost import linearise_view
from connrsfm_graph.refine.elimination import Factorised, spread_view
from connrsfm_graph.refine.envelope import factor_damped, substitute
from connrsfm_graph.refine.measurements import Measurements, Shape, kernel_arguments, lag, linearise
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.threads import over_views

_SAMPLES = 20
_AT_ONCE = 5
"""Samples that are solved together."""
_TOLERANCE = 0.03
"""Relative accuracy of the linear solutions, well below that of a deviation from so few draws."""
_SUREST = 0.00125
"""Standard deviation of a log length, at least: a fit may hold them tighter, but chords of a mesh are not arcs, and
such a fit is never quite at its minimum."""
_SMOOTHINGS = 4
"""Averages over neighbours that make independent noise a stretch of the surface."""


def log_depth_deviation(
    measurements: Measurements,
    shape: Shape,
    stretch: bool,
    lengths_pull: np.ndarray | None = None,
    about_mean: bool = False,
    seed: int = 0,
) -> np.ndarray:
    """(F, P) standard deviation of log depth, the scale common to all views left out.

    Args:
        measurements: with the noise levels of the fit; lengths held tighter than to 0.00125 count as held to that.
        shape: minimum of the cost.
        stretch: whether lengths vary alike for neighbours.
        lengths_pull: (E,) what `pull` says of the lengths, where those are of other views. They are taken as known but
            for that, views do not depend on each other, and all have the same draws. None where views and lengths were
            fitted together.
        about_mean: whether the mean of every view is left out as well, which views from afar do not tell; of views
            fitted together only.
        seed: of the draws.
    """
    measurements = _held(measurements)
    drawn = len(shape.log_depth) if lengths_pull is None else 1
    draws = _draws(np.random.default_rng(seed), drawn, measurements.mesh, stretch)
    if lengths_pull is None:
        variance = _variance_of_all(measurements, shape, draws, about_mean)
    else:
        variance = _variance_of_each(measurements, shape, draws, lengths_pull)
    # Variances vary slowly over the surface, their estimates from a few draws do not.
    return np.asarray(np.sqrt(_around(variance, measurements.mesh)))


def pull(measurements: Measurements, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """By how much the prior on slants moves log depths (F, P) and log lengths (E,) when it grows by a factor of e, the
    scale common to all views left out.

    Args:
        measurements, shape: as in `log_depth_deviation`, of views and lengths that were fitted together.
    """
    measurements = _held(measurements)
    envelope = measurements.envelope(shape.log_factor.size > 0)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    return _pull(measurements, Factorised(equations, envelope, measurements.mesh.edges))


def _held(measurements: Measurements) -> Measurements:
    """With lengths held no tighter than counts."""
    return replace(measurements, length_weight=np.minimum(measurements.length_weight, 1.0 / _SUREST))


def _pull(measurements: Measurements, factorised: Factorised) -> tuple[np.ndarray, np.ndarray]:
    mesh, frontal, unknown = measurements.mesh, measurements.frontal, factorised.envelope.unknown
    views = np.zeros_like(factorised.equations.gradient)
    views[:, unknown] = -0.5 * np.bincount(mesh.edges.ravel(), np.repeat(frontal, 2), mesh.n_points)
    border = np.zeros_like(factorised.equations.border_gradient)
    border[: len(mesh.edges)] = len(views) * frontal
    views, border = (moved[0] for moved in factorised.solve(views[None], border[None], _TOLERANCE))
    depths, lengths = views[:, unknown], border[: len(mesh.edges)]
    return depths - depths.mean(), lengths - depths.mean()  # loose edges, of which it is free, shift the mean length


def _variance_of_all(
    measurements: Measurements, shape: Shape, draws: Iterator[tuple[np.ndarray, np.ndarray]], about_mean: bool
) -> np.ndarray:
    """(F, P) mean squares of the log depths' errors, views and lengths solved together."""
    envelope = measurements.envelope(shape.log_factor.size > 0)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    factorised = Factorised(equations, envelope, measurements.mesh.edges)
    rays = envelope.unknown[:, None] + np.array([1, 2])
    square = np.zeros_like(shape.log_depth)
    for _ in range(_SAMPLES // _AT_ONCE):
        lengths, images = (np.stack(parts) for parts in zip(*islice(draws, _AT_ONCE), strict=True))
        noise = lengths / measurements.length_weight
        gradient = -factorised.spread(noise)
        gradient[..., rays] += measurements.image_weight[..., None] * images
        views, _ = factorised.solve(gradient, factorised.border_part(-equations.weight * noise), _TOLERANCE)
        error = views[..., envelope.unknown]
        if about_mean:
            error = error - error.mean(axis=-1, keepdims=True)
        square += (error**2).sum(axis=0)
    pulled, _ = _pull(measurements, factorised)
    if about_mean:
        pulled -= pulled.mean(axis=1, keepdims=True)
    return square / _SAMPLES + pulled**2


def _variance_of_each(
    measurements: Measurements,
    shape: Shape,
    draws: Iterator[tuple[np.ndarray, np.ndarray]],
    lengths_pull: np.ndarray,
) -> np.ndarray:
    """The same with the lengths known but for what pulls at them."""
    lengths, images = (np.concatenate(parts) for parts in zip(*draws, strict=True))
    envelope = measurements.envelope(shape.log_factor.size > 0)
    square = np.empty_like(shape.log_depth)
    arguments = kernel_arguments(measurements, shape, lag(measurements, shape))
    over_views(_variance_kernel, len(square), *arguments, envelope, lengths, images, lengths_pull, square)
    return square


@njit(cache=True, nogil=True)
def _variance_kernel(
    first, last, X, f, drift, offset, correction, image_weight, length_weight, factor_weight, terms, envelope,
    lengths, images, lengths_pull, square,
):  # fmt: skip
    """Mean squares into `square` (F, P) for views first to last - 1; NaN where a matrix is not positive definite.

    Arguments up to `envelope` are those of `linearise_kernel`, `lengths` (S, E) and `images` (S, P, 2) the draws,
    `lengths_pull` (E,).
    """
    unknown = envelope.unknown
    n, E, m = len(envelope.first), len(terms.edges), len(envelope.first) // len(unknown)
    ends = np.empty((E, 2), np.int64)
    for e in range(E):
        ends[e, 0], ends[e, 1] = unknown[terms.edges[e, 0]], unknown[terms.edges[e, 1]]
    matrix, gradient, border = np.empty(envelope.start[-1]), np.empty(n), np.empty((E, 2 * m))
    residual, weight, noise = np.empty(E), np.empty(E), np.empty(E)
    for v in range(first, last):
        linearise_view(
            X[v], f[v], drift[v], offset[v], correction[v], image_weight[v], length_weight[v], factor_weight[v], terms,
            envelope, matrix, gradient, border, residual, weight,
        )  # fmt: skip
        square[v] = 0.0
        if not factor_damped(matrix, 0.0, envelope.first, envelope.start):
            square[v] = np.nan
            continue
        for s in range(len(lengths)):
            gradient[:] = 0.0
            for e in range(E):
                noise[e] = -lengths[s, e] / length_weight[v, e]
            spread_view(border, weight, ends, noise, gradient)
            for i in range(len(unknown)):
                gradient[unknown[i] + 1] += image_weight[v, i] * images[s, i, 0]
                gradient[unknown[i] + 2] += image_weight[v, i] * images[s, i, 1]
            substitute(matrix, envelope.first, envelope.start, gradient)
            for i in range(len(unknown)):
                square[v, i] += gradient[unknown[i]] ** 2 / len(lengths)
        gradient[:] = 0.0
        spread_view(border, weight, ends, lengths_pull, gradient)
        for e in range(E):
            for end in range(2):
                gradient[ends[e, end]] -= 0.5 * terms.frontal[e]
        substitute(matrix, envelope.first, envelope.start, gradient)
        for i in range(len(unknown)):
            square[v, i] += gradient[unknown[i]] ** 2


def _draws(rng: np.random.Generator, drawn: int, mesh: Mesh, stretch: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Errors of the lengths (drawn, E) and of the image points (drawn, P, 2), in standard deviations."""
    for _ in range(_SAMPLES):
        yield _length_noise(rng, drawn, mesh, stretch), rng.standard_normal((drawn, mesh.n_points, 2))


def _length_noise(rng: np.random.Generator, drawn: int, mesh: Mesh, stretch: bool) -> np.ndarray:
    if not stretch:
        return rng.standard_normal((drawn, len(mesh.edges)))
    field = rng.standard_normal((drawn, mesh.n_points))
    for _ in range(_SMOOTHINGS):
        field = _around(field, mesh)
    field /= field.std()
    return np.asarray(0.5 * (field[:, mesh.edges[:, 0]] + field[:, mesh.edges[:, 1]]))


def _around(values: np.ndarray, mesh: Mesh) -> np.ndarray:
    """(F, P) means over every point and its near neighbours."""
    total, count = values.copy(), np.ones(mesh.n_points)
    near = mesh.edges[: mesh.n_near]
    for a, b in ((0, 1), (1, 0)):
        np.add.at(total.T, near[:, a], values.T[near[:, b]])
        np.add.at(count, near[:, a], 1.0)
    return np.asarray(total / count)
