"""Views of an isometric fit that are caught in a wrong shape: they cost more than others, and start again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag
from connrsfm_graph.refine.reseat import reseat
from connrsfm_graph.refine.restarts import restart
from connrsfm_graph.refine.task import Fit, Task, minimised

RESTARTS = 4
"""Rounds of restarts, at most."""
_SUSPECT = (1.5, 0.02)
"""So may one be that costs so many times the lower quartile of the views, and so much per edge."""


def restarted_where_dear(task: Task, found: Fit, lend: bool = False) -> Fit:
    """The fit with views that cost more than others restarted until none gains; `lend` says whether also from the
    surfaces of those others."""
    measurements = found.measurements
    for _ in range(RESTARTS):
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


def reseated_where_dear(task: Task, found: Fit) -> Fit:
    """The fit with single points elsewhere in views that still cost more than others, as long as that pays."""
    for _ in range(RESTARTS):
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
