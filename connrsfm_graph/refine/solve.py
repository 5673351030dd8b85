"""Levenberg-Marquardt on the refinement's cost: all views and lengths jointly, or each view on its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.refine.elimination import Factorised, NormalEquations
from connrsfm_graph.refine.measurements import (
    OF_VIEWS,
    Measurements,
    Shape,
    lag,
    linearise,
    moved,
    stencils_of,
    terms_of,
    total_cost,
)
from connrsfm_graph.refine.memory import Memory
from connrsfm_graph.refine.one_view import fit_views_kernel
from connrsfm_graph.refine.stretch import stretches
from connrsfm_graph.threads import over_views

_DAMPING = (1e-3, 1e-7, 1e6)
"""First, smallest and largest damping."""
_CLOSE_DAMPING = 1e-6
"""First one of close steps."""
_STRANGE = 1.0
"""From this damping on equations have little in common with those before."""
_EXACT = 1e-6
"""Mean squared length residual, in assumed variances, below which the data are exact and nothing is left to gain."""
_INNER_TOLERANCE = 0.2
"""Relative accuracy of the conjugate gradients: what they leave the next iteration corrects, as it does curvature."""
_CLOSE_TOLERANCE = 0.05
"""That of close steps."""
_COINCIDENT = 1e-300
"""Squared chords are at least so long, as in the factors."""


def minimise(
    measurements: Measurements, shape: Shape, iterations: int, tolerance: float, closely: bool = False
) -> tuple[Shape, list[float]]:
    """All views and the lengths together.

    Where tracks tell little the cost has bent valleys, along which straight and roughly solved steps descend slowly:
    good enough for a surface, too slow for fits that are to be compared.

    Args:
        measurements: image points, mesh and weights.
        shape: start, which close steps ask to be near a minimum: from afar they lead to others.
        iterations: at most so many.
        tolerance: stop where an iteration lowers the cost by less than this part.
        closely: whether steps are solved closely, hardly damped at first, and bent where straight ones are refused.

    Returns:
        The shape and the cost at the start and after every iteration.
    """
    envelope = measurements.envelope(shape.log_factor.size > 0)
    damping, smallest, largest = _DAMPING
    inner = _INNER_TOLERANCE
    if closely:
        damping, inner = _CLOSE_DAMPING, _CLOSE_TOLERANCE
    lagged = lag(measurements, shape)
    history = [total_cost(measurements, shape, lagged)]
    storage, memory = None, Memory()
    for _ in range(iterations):
        before = total_cost(measurements, shape, lagged)
        while damping <= largest:
            equations, _ = linearise(measurements, shape, lagged, envelope, storage)
            storage = equations.matrix
            try:
                known = None if damping >= _STRANGE else memory
                factorised = Factorised(equations, envelope, measurements.mesh.edges, damping, known)
                trial = moved(shape, envelope, *factorised.step(inner))
                after = total_cost(measurements, trial, lagged)
                if closely and before < after < np.inf:
                    missed = _missed(measurements, shape, trial, equations)
                    trial = moved(trial, envelope, *factorised.correction(missed, inner))
                    after = total_cost(measurements, trial, lagged)
            except ComputationError:
                after = np.inf
            if after <= before:
                break
            damping *= 10.0
        else:
            break
        damping = max(damping / 10.0, smallest)
        shape = trial
        lagged = lag(measurements, shape)
        history.append(after)
        if before - after <= tolerance * before or after <= 0.5 * _EXACT * measurements.length_weight.size:
            break
    return shape, history


def _missed(measurements: Measurements, shape: Shape, trial: Shape, equations: NormalEquations) -> np.ndarray:
    """(F, E) by how much log chords less stretches change more than their derivatives at a shape say."""
    mesh, border = measurements.mesh, equations.border
    i, k = mesh.edges.T
    lengths = []
    for each in (shape, trial):
        points = each.points(measurements.image)
        square = ((points[:, i] - points[:, k]) ** 2).sum(axis=-1)
        lengths.append(0.5 * np.log(np.maximum(square, _COINCIDENT)) - stretches(each.strain, mesh)[0])
    depth = (trial.log_depth - shape.log_depth)[..., None]
    step = np.concatenate([depth, trial.correction - shape.correction], axis=-1)
    m = border.shape[-1] // 2
    linear = (border[..., :3] * step[:, i]).sum(axis=-1) + (border[..., m : m + 3] * step[:, k]).sum(axis=-1)
    linear -= np.einsum("fek,fk->fe", equations.by_strain, trial.strain - shape.strain)
    return np.asarray(lengths[1] - lengths[0] - linear)


def fit_views(measurements: Measurements, shape: Shape, iterations: int, tolerance: float) -> tuple[Shape, np.ndarray]:
    """Each view on its own, lengths and strains held.

    Args:
        measurements, shape: as in `minimise`.
        iterations: at most so many.
        tolerance: a view's fit ends where an iteration lowers its cost by less than this part.

    Returns:
        The shape and the (F,) costs.
    """
    envelope = measurements.envelope(shape.log_factor.size > 0)
    mesh, found = measurements.mesh, replace(shape, **{name: getattr(shape, name).copy() for name in OF_VIEWS})
    cost = np.empty(len(shape.log_depth))
    over_views(
        fit_views_kernel,
        len(cost),
        measurements.image,
        measurements.image_weight,
        measurements.log_depth,
        measurements.length_weight,
        measurements.factor_weight,
        mesh.triangles,
        measurements.splines(),
        stretches(shape.strain, mesh)[0],
        terms_of(measurements, shape, stencils_of(measurements, shape)),
        envelope,
        iterations,
        tolerance,
        0.5 * _EXACT * len(mesh.edges),
        _DAMPING,
        found.log_depth,
        found.correction,
        found.log_factor,
        cost,
    )
    return found, cost
