"""Slants that the data leave open: seen frontally, as far as points left out say.

Where tracks tell little, as of a surface that hardly bends before a camera that hardly moves, surfaces of many slants
fit them nearly equally well, and the noise decides between them. Slants that a visible surface has by chance are a
better judge (see `factors.frontal`). How much is left to them the data say, by points that the fit was not given.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.held_out import gain, prediction_errors
from connrsfm_graph.refine.settle import BEYOND_DOUBT
from connrsfm_graph.refine.task import Fit, Task, refitted

_COMPARED, _TAKEN = (12, 3e-4), (60, 1e-4)
"""Iterations at most and tolerance of the fits that are compared, and of the one that is taken: slants move last."""
_FLATTENED = 0.25
"""Part of their relief that surfaces keep in a second start: what is far too steep comes down slowly by itself."""


def seen_frontally(task: Task, found: Fit) -> Fit:
    """An isometric fit, its surfaces taken to be seen frontally as far as points left out say.

    Taken is the prior with which points left out are predicted best, where that is better than without any.
    """
    if found.misfit() < BEYOND_DOUBT or not task.config.frontal_patches:
        return found
    compared, taken = (
        replace(task, config=replace(task.config, iterations=iterations, tolerance=tolerance))
        for iterations, tolerance in (_COMPARED, _TAKEN)
    )
    without = refitted(compared, found, found.noise)
    errors = prediction_errors(without.measurements, without.shape, task.seen)
    best, most = found, 0.0
    starts = [found, _flattened(found)]
    for patches in task.config.frontal_patches:
        noise = replace(found.noise, patches=patches)
        trial = min((refitted(compared, start, noise) for start in starts), key=lambda fit: fit.history[-1])
        better_by, _ = gain(prediction_errors(trial.measurements, trial.shape, task.seen), errors)
        if better_by > most:
            best, most = trial, better_by
        starts = [trial]
    return found if best is found else refitted(taken, best, best.noise)


def _flattened(found: Fit) -> Fit:
    """Less relief in all views, and the lengths that these then show."""
    shape = found.shape
    mean = shape.log_depth.mean(axis=1, keepdims=True)
    less = replace(shape, log_depth=mean + _FLATTENED * (shape.log_depth - mean))
    length = less.log_length + np.median(replace(found, shape=less).residuals(), axis=0)
    unit = length.mean()
    return replace(found, shape=replace(less, log_depth=less.log_depth - unit, log_length=length - unit))
