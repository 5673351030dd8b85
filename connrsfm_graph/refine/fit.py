"""Fits of the isometric and of the conformal model, and the choice between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.ambiguity import resolve
from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.reseat import reseat
from connrsfm_graph.refine.restarts import inverted, restart
from connrsfm_graph.refine.settle import BEYOND_DOUBT, noise_evidence, settled, trusting_lengths
from connrsfm_graph.refine.slant import seen_frontally
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Fit, Task, minimised

_RESTARTS = 4
"""Rounds of restarts, at most."""
_SUSPECT = (1.5, 0.02)
"""So may one of an isometric fit that costs so many times the lower quartile of the views, and so much per edge."""
_PROMISING = 2.0
"""Views of a second fit are restarted where it costs at most this many times the first."""
_MISFIT = 1.0
"""Isometry is in doubt where its squared residuals exceed this many assumed variances on average."""
_DOUBT = 0.15
"""The same for the conformal model, which bends to many a wrong shape: its fit is then repeated from flat views."""
_RATIO = 6.0
"""The conformal model must then lower the cost by this factor: its many unknowns alone already gain a lot."""


def fit(task: Task, sigma_image: float) -> Fit:
    """The model that the data ask for, or the one that was asked for.

    Args:
        task: what is to be fitted.
        sigma_image: standard deviation of the image points, normalised coordinates; NaN where not known.
    """
    noise = Noise.start(sigma_image, task.config.length_sigma, task.spacing())
    wanted = task.config.model
    if wanted == "conformal":
        return fit_conformal(task, noise)
    isometric = fit_isometric(task, noise)
    misfit = isometric.misfit()
    isometric.evidence["isometric misfit"] = misfit
    if wanted == "isometric" or misfit <= _MISFIT:
        return _finished(task, isometric)
    conformal = fit_conformal(task, noise)
    ratio = isometric.first_cost / max(conformal.first_cost, 1e-300)
    for found in (isometric, conformal):
        found.evidence["isometric misfit"] = misfit
        found.evidence["isometric over conformal cost"] = ratio
    return conformal if ratio > _RATIO else _finished(task, isometric)


def fit_isometric(task: Task, noise: Noise) -> Fit:
    """Isometric fit from the start and, where that leaves a doubt, from flat views; the cheaper one stays.

    Where even that one misses isometry, views that cost more than others start from what those have found. Views that
    are caught may show only when the noise levels are known, so they are looked for once more in the end.
    """
    found = _from_start(task, noise)
    misfit = found.misfit()
    if misfit > _MISFIT or (misfit > BEYOND_DOUBT and not found.looks_like_noise(task)):
        # The surface may stretch, or the start may be to blame for all views alike; flat ones are neutral.
        flat = replace(task, completed=replace(task.completed, log_depth=np.zeros_like(task.completed.log_depth)))
        again = _from_start(flat, noise, _PROMISING * found.first_cost)
        if again.first_cost < found.first_cost:
            task, found = flat, again
    if found.misfit() > _MISFIT:
        found = _restarted_where_dear(task, found, lend=True)
    found = settled(task, _reseated(task, found))
    return replace(_restarted_where_dear(task, found), first_cost=found.first_cost)


def _finished(task: Task, isometric: Fit) -> Fit:
    """The isometric fit that is taken, with the prior on slants and the trust in lengths that the data ask for."""
    found = trusting_lengths(task, seen_frontally(task, isometric))
    found.evidence.update(noise_evidence(task, found))
    return found


def _from_start(task: Task, noise: Noise, worth: float = np.inf) -> Fit:
    """Isometric fit; where it costs less than `worth`, views that cost more than others are restarted."""
    measurements = task.measurements(noise, conformal=False)
    shape, history = minimised(task, measurements, start_shape(task.completed, task.mesh))
    found = Fit(measurements, shape, noise, history, history[-1])
    return _restarted_where_dear(task, found) if history[-1] < worth else found


def _restarted_where_dear(task: Task, found: Fit, lend: bool = False) -> Fit:
    """The fit with views that cost more than others restarted until none gains; `lend` says whether also from the
    surfaces of those others."""
    measurements = found.measurements
    for _ in range(_RESTARTS):
        suspect = _suspect(measurements, found.shape)
        if len(suspect) == 0:
            break
        others = np.delete(found.shape.points(measurements.image), suspect, axis=0) if lend else None
        better, renewed = restart(measurements.views(suspect), found.shape.views(suspect), others)
        if not renewed.any():
            break
        shape, more = minimised(task, measurements, found.shape.replaced(suspect, better))
        found = replace(found, shape=shape, history=found.history + more, first_cost=more[-1])
    return found


def _suspect(measurements: Measurements, shape: Shape) -> np.ndarray:
    """Numbers of the views that cost more than others."""
    factor, per_edge = _SUSPECT
    cost = costs(measurements, shape, lag(measurements, shape))
    return np.flatnonzero(cost > max(factor * np.quantile(cost, 0.25), per_edge * len(measurements.mesh.edges)))


def _reseated(task: Task, found: Fit) -> Fit:
    """The fit with single points elsewhere in views that still cost more than others, as long as that pays."""
    for _ in range(_RESTARTS):
        suspect = _suspect(found.measurements, found.shape)
        if len(suspect) == 0:
            break
        better, renewed = reseat(found.measurements.views(suspect), found.shape.views(suspect))
        if not renewed.any():
            break
        shape, more = minimised(task, found.measurements, found.shape.replaced(suspect, better))
        if not more[-1] < found.first_cost:
            break
        found = replace(found, shape=shape, history=found.history + more, first_cost=more[-1])
    return found


def fit_conformal(task: Task, noise: Noise) -> Fit:
    """Conformal fit from the start, or from flat views where that remains in doubt, then inversions resolved.

    Views declared isometric are held to it only in the end: on the way it would keep wrong shapes from turning right.
    """
    measurements = task.measurements(noise, conformal=True, declared=False)
    shape, history = _restarted(task, measurements, start_shape(task.completed, task.mesh, conformal=True))
    (F, P), E = shape.log_depth.shape, len(shape.log_length)
    if 2.0 * history[-1] > _DOUBT * max(F * E - 2 * F * P - E, 1):
        flat = replace(task.completed, log_depth=np.zeros((F, P)))
        second, more = _restarted(task, measurements, start_shape(flat, task.mesh, conformal=True))
        if more[-1] < history[-1]:
            shape, history = second, history + more
    shape, ambiguity = resolve(shape, measurements.image, task.mesh, task.declared)
    measurements = task.measurements(noise, conformal=True)
    shape, more = minimised(task, measurements, shape)
    history += more
    alternative = None
    if ambiguity.group.any():
        alternative, other = minimised(task, measurements, inverted(shape, measurements.image, ambiguity.group > 0))
        # Where one inversion is common to several undecided views, the conformal factors decide which varies less.
        if np.count_nonzero(ambiguity.group == 1) > 1 and other[-1] < history[-1]:
            shape, alternative = alternative, shape
            history += other
    found = trusting_lengths(task, settled(task, Fit(measurements, shape, noise, history, history[-1])))
    found.evidence.update(noise_evidence(task, found))
    found.evidence["conformal factors rest on"] = ambiguity.assumption
    found.evidence["views that might be inverted"] = np.flatnonzero(ambiguity.group).tolist()
    return replace(found, ambiguity=ambiguity, alternative=alternative)


def _restarted(task: Task, measurements: Measurements, shape: Shape) -> tuple[Shape, list[float]]:
    """Minimum from a shape, all views restarted until none gains, and the costs on the way."""
    shape, history = minimised(task, measurements, shape)
    for _ in range(_RESTARTS):
        shape, renewed = restart(measurements, shape)
        if not renewed.any():
            break
        shape, more = minimised(task, measurements, shape)
        history += more
    return shape, history
