"""Slants that the data leave open: seen frontally, as far as points left out say.

Where tracks tell little, as of a surface that hardly bends before a camera that hardly moves, surfaces of many slants
fit them nearly equally well, and the noise decides between them. Slants that a visible surface has by chance are a
better judge (see `factors.frontal`). How much is left to them the data say, by points that the fit was not given.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.held_out import errors_of, gain
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.planes import from_planes
from connrsfm_graph.refine.settle import BEYOND_DOUBT
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Fit, Task, refitted, to_the_end
from connrsfm_graph.refine.uncertainty import pull
from connrsfm_graph.threads import mapped

MOVED = "part of the relief that frontal patches move"
"""What the evidence calls the part by which the weakest prior would move surfaces."""
_OPEN = 0.01
"""Slants are settled where the weakest prior would move surfaces by no more than this part of their relief."""
_COMPARED = (12, 3e-4)
"""Iterations at most and tolerance of the fits that are compared. Slants move last: the one that is taken goes to its
end."""
_FLATTENED = 0.25
"""Part of their relief that surfaces keep in a second start: what is far too steep comes down slowly by itself."""


def seen_frontally(task: Task, found: Fit) -> Fit:
    """An isometric fit, its surfaces taken to be seen frontally as far as points left out say.

    Taken is the prior with which points left out are predicted best, where that is better than without any. Where a
    fit under the prior leads to a cheaper one without it, that one is gone on with.
    """
    if found.misfit() < BEYOND_DOUBT or not task.config.frontal_patches:
        return found
    priors = [replace(found.noise, patches=patches) for patches in task.config.frontal_patches]
    found.evidence[MOVED] = moved = _moved(task, found, priors[0])
    if moved <= _OPEN:
        return found
    iterations, tolerance = _COMPARED
    compared = replace(task, config=replace(task.config, iterations=iterations, tolerance=tolerance))
    planes = from_planes(task, lambda plane: _from_plane(task, found, priors[0], plane))
    starts = [found, _flattened(found), *(fit for _, fit in planes)]
    first = min(mapped(lambda start: refitted(compared, start, priors[0]), starts), key=lambda fit: fit.history[-1])
    without, other = mapped(lambda start: refitted(compared, start, found.noise), (found, first))
    if other.history[-1] < without.history[-1]:
        found = without = other
    trials = [first]
    for noise in priors[1:]:
        trials.append(refitted(compared, trials[-1], noise))
    errors, *under_priors = errors_of((without, *trials), task.seen)
    best, most = found, 0.0
    for trial, under_prior in zip(trials, under_priors, strict=True):
        better_by, _ = gain(under_prior, errors)
        if better_by > most:
            best, most = trial, better_by
    return found if best is found else to_the_end(best)


def _moved(task: Task, found: Fit, noise: Noise) -> float:
    """Root mean square by which the prior would move the log depths of a fit, over that of their relief."""
    depths, _ = pull(task.measurements(noise, conformal=False), found.shape)
    relief = found.shape.log_depth - found.shape.log_depth.mean(axis=1, keepdims=True)
    return float(np.sqrt((depths**2).mean() / np.maximum((relief**2).mean(), 1e-300)))


def _from_plane(task: Task, found: Fit, noise: Noise, plane: Task) -> Fit:
    """A fit from a plane, under the settings that go with it."""
    shape = replace(start_shape(plane.completed, task.mesh), strain=np.zeros_like(found.shape.strain))
    return refitted(replace(task, config=plane.config), replace(found, shape=shape), noise)


def _flattened(found: Fit) -> Fit:
    """Less relief in all views, and the lengths that these then show."""
    shape = found.shape
    mean = shape.log_depth.mean(axis=1, keepdims=True)
    less = replace(shape, log_depth=mean + _FLATTENED * (shape.log_depth - mean))
    length = less.log_length + np.median(replace(found, shape=less).residuals(), axis=0)
    unit = length.mean()
    return replace(found, shape=replace(less, log_depth=less.log_depth - unit, log_length=length - unit))
