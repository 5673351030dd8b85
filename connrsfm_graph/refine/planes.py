"""Starts from planes that lean alike in all views.

All views may be caught in the same wrong slant, before a camera at rest above all, and none can tell the others: what
a start says is nearly consistent, and so is what comes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.task import Fit, Task
from connrsfm_graph.threads import mapped

_INCLINATION, _DIRECTIONS = 30.0, 6
"""Degrees and number of directions of the planes."""
_PROMISING = (6, 2)
"""So many iterations tell which of them are; so many are gone on with."""


def from_planes(task: Task, fitted: Callable[[Task], Fit]) -> list[tuple[Task, Fit]]:
    """Tasks that start from the most promising planes, and what becomes of these in a few iterations.

    Args:
        task: what is to be fitted.
        fitted: a fit from where a task starts, under its settings.

    Returns:
        The tasks, with all iterations, and the fits; the cheapest first.
    """
    iterations, kept = _PROMISING
    angles = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    slope = np.tan(np.radians(_INCLINATION))
    planes = [task.inclined(slope * np.array([np.cos(angle), np.sin(angle)])) for angle in angles]
    quick = replace(task.config, iterations=iterations)
    fits = list(mapped(lambda plane: fitted(replace(plane, config=quick)), planes))
    order = sorted(range(_DIRECTIONS), key=lambda number: fits[number].history[-1])
    return [(planes[number], fits[number]) for number in order[:kept]]
