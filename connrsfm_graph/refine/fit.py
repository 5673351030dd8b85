"""Fits of the isometric and of the conformal model, and the choice between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.ambiguity import resolve
from connrsfm_graph.refine.caught import RESTARTS, reseated_where_dear, restarted_where_dear
from connrsfm_graph.refine.measurements import Measurements, Shape
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.planes import from_planes
from connrsfm_graph.refine.restarts import inverted, restart
from connrsfm_graph.refine.settle import BEYOND_DOUBT, noise_evidence, over_smooth_arcs, settled, trusting_lengths
from connrsfm_graph.refine.slant import seen_frontally
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.strain import stretched
from connrsfm_graph.refine.task import Fit, Task, minimised

_PROMISING = 2.0
"""Views of a second fit are restarted where it costs at most this many times the first."""
_LED_OUT = 0.8
"""Part of a cost to which planes that lean must lower it: less is a matter of chance, before noise levels are known."""
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
    misfit = isometric.misfit()  # without strains, which explain a part of what is conformal
    own, isometric = stretched(task, isometric, noise)
    isometric.evidence["isometric misfit"] = misfit
    if wanted == "isometric" or misfit <= _MISFIT:
        return _finished(own, isometric)
    conformal = fit_conformal(task, noise)
    ratio = isometric.first_cost / max(conformal.first_cost, 1e-300)
    for found in (isometric, conformal):
        found.evidence["isometric misfit"] = misfit
        found.evidence["isometric over conformal cost"] = ratio
    return conformal if ratio > _RATIO else _finished(own, isometric)


def fit_isometric(task: Task, noise: Noise) -> Fit:
    """Isometric fit from the start and, where that leaves a doubt, from planes; the cheapest one stays.

    Where even that one misses isometry, views that cost more than others start from what those have found. Views that
    are caught may show only when the noise levels are known, so they are looked for once more in the end.
    """
    found = _from_start(task, noise)
    for plane, worth in _planes(task, found):
        again = _from_start(plane, noise, _PROMISING * found.first_cost)
        if again.first_cost < worth * found.first_cost:
            task, found = plane, again
    if found.misfit() > _MISFIT:
        found = restarted_where_dear(task, found, lend=True)
    found = settled(task, reseated_where_dear(task, found))
    return replace(restarted_where_dear(task, found), first_cost=found.first_cost)


def _planes(task: Task, found: Fit) -> list[tuple[Task, float]]:
    """Planes to start from that may lead further than a fit has come, and to what part of its cost they must.

    The surface may stretch, or the start may be to blame for all views alike; views that face the camera are neutral,
    and planes that lean lead out of wrong slants.
    """
    misfit = found.misfit()
    if misfit <= BEYOND_DOUBT:
        return []
    neutral = [(task.flat(), 1.0)] if misfit > _MISFIT or not found.looks_like_noise(task) else []
    leaning = from_planes(task, lambda plane: _from_start(plane, found.noise, 0.0))
    return neutral + [(plane, _LED_OUT) for plane, _ in leaning]


def _finished(task: Task, isometric: Fit) -> Fit:
    """The isometric fit that is taken, with the arcs, the prior on slants and the trust in lengths that the data ask
    for."""
    task, found = over_smooth_arcs(task, isometric)
    found = trusting_lengths(task, seen_frontally(task, found))
    found.evidence.update(noise_evidence(task, found))
    return found


def _from_start(task: Task, noise: Noise, worth: float = np.inf) -> Fit:
    """Isometric fit; where it costs less than `worth`, views that cost more than others are restarted."""
    measurements = task.measurements(noise, conformal=False)
    shape, history = minimised(task, measurements, start_shape(task.completed, task.mesh))
    found = Fit(measurements, shape, noise, history, history[-1])
    return restarted_where_dear(task, found) if history[-1] < worth else found


def fit_conformal(task: Task, noise: Noise) -> Fit:
    """Conformal fit from the start, or from flat views where that remains in doubt, then inversions resolved.

    Views declared isometric are held to it only in the end: on the way it would keep wrong shapes from turning right.
    """
    measurements = task.measurements(noise, conformal=True, declared=False)
    shape, history = _restarted(task, measurements, start_shape(task.completed, task.mesh, conformal=True))
    (F, P), E = shape.log_depth.shape, len(shape.log_length)
    if 2.0 * history[-1] > _DOUBT * max(F * E - 2 * F * P - E, 1):
        flat = task.flat().completed
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
    for _ in range(RESTARTS):
        shape, renewed = restart(measurements, shape)
        if not renewed.any():
            break
        shape, more = minimised(task, measurements, shape)
        history += more
    return shape, history
