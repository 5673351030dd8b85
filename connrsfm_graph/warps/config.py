"""Configuration of the image warps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from connrsfm_graph.errors import InputError

Model = Literal["auto", "schwarzian", "bending", "gaussian_process"]
MIN_POINTS = 6
"""Fewest shared points that any warp can be fitted to: an affinity plus something to check it with."""


@dataclass(frozen=True)
class WarpConfig:
    """How the warp of every edge is fitted. Weights have no units: each image's points are scaled to unit spread."""

    model: Model = "auto"
    """`schwarzian` (the paper's spline), `bending` (the same spline with bending energy only), `gaussian_process`, or
    `auto`: the Gaussian process where the evidence says that the points follow a smooth map, the Schwarzian spline
    where they show detail finer than `shortest_scale`."""
    control_points: int = 10
    """Control points of the spline per axis."""
    padding: float = 0.1
    """Widening of the spline's rectangle beyond the points, as a fraction of its size, on every side."""
    schwarzian: float | None = 0.1
    """Weight of the Schwarzian penalty; none: chosen as the one that predicts left-out points best."""
    bending: float | None = None
    """Weight of the bending energy of `bending`; none: chosen as the one that predicts left-out points best."""
    shortest_scale: float = 1.0
    """Shortest length scale of the Gaussian process, in units of the spread of the points. Finer detail counts as noise
    in a warp, whose second derivatives it would ruin."""
    min_points: int = 6
    """An edge with fewer shared points gets no warp."""
    robust: bool = True
    """Give less weight to points that the warp fitted to the others does not explain (wrong tracks)."""
    covariance: bool = True
    """Compute the covariance of the jets."""
    probe_edges: int = 6
    """Edges, spread over the list, on which model and weights are chosen for the whole data set."""

    def __post_init__(self) -> None:
        if self.model not in get_args(Model):
            raise InputError(f"warp model is '{self.model}', expected one of {', '.join(get_args(Model))}")
        if not 5 <= self.control_points <= 40:
            raise InputError(f"warp control_points is {self.control_points}, expected 5 to 40")
        if self.min_points < MIN_POINTS:
            raise InputError(f"warp min_points is {self.min_points}, expected at least {MIN_POINTS}")
        if self.probe_edges < 1:
            raise InputError(f"warp probe_edges is {self.probe_edges}, expected at least 1")
        for name in ("schwarzian", "bending", "shortest_scale"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"warp {name} is {value}, expected a positive number")
        if not 0 <= self.padding < np.inf:
            raise InputError(f"warp padding is {self.padding}, expected zero or more")
