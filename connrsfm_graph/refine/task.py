"""What the refinement is to fit, and a fit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from connrsfm_graph.refine.ambiguity import Ambiguity
from connrsfm_graph.refine.arcs import ArcSplines
from connrsfm_graph.refine.config import RefineConfig
from connrsfm_graph.refine.cost import Weights
from connrsfm_graph.refine.measurements import Measurements, Shape, lag, linearise
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.noise import Noise, neighbour_correlation
from connrsfm_graph.refine.solve import minimise
from connrsfm_graph.refine.start import start_mesh, start_shape
from connrsfm_graph.refine.unseen import Completed
from factors.frontal import PER_PATCH

_CLOSE = (60, 1e-5)
"""Iterations at most and tolerance of the last steps to a minimum."""
_UNIT = 1e3
"""Inverse standard deviation of the mean log length."""
_DRIFT = 0.3
"""Inverse standard deviation of log depths about their start."""
_FACTOR = 0.1
"""Inverse standard deviation of log conformal factors."""
_DECLARED_FACTOR = 1e3
"""The same for views declared isometric."""
_SHORT = 0.5
"""Edges that noise turns are loosened where they are shorter than this part of what is usual about them, by the square
of how much they are. The logarithms of their lengths are far from linear in that: they tell little, and steps of the
whole fit would be no longer than the shortest edge. Not so in a conformal model, which has few to spare."""


@dataclass(frozen=True)
class Task:
    """What is to be fitted."""

    completed: Completed
    """Image points and log depths of all views, interpolated where not seen."""
    seen: np.ndarray
    """(F, P) bool."""
    mesh: Mesh
    """Neighbours."""
    config: RefineConfig
    """Settings."""
    arcs: ArcSplines | None = None
    """What surfaces are smoothed by before arcs are measured over them; None where they are not."""

    @staticmethod
    def of(completed: Completed, seen: np.ndarray, config: RefineConfig) -> Task:
        """With the mesh of the start."""
        return Task(completed, seen, start_mesh(completed, seen, config.rings), config)

    @property
    def declared(self) -> np.ndarray:
        """(F,) bool, views declared isometric to each other."""
        return np.isin(np.arange(len(self.seen)), self.config.isometric_views)

    def flat(self) -> Task:
        """The same from flat views in front of the camera."""
        return self.inclined(np.zeros(2))

    def inclined(self, slope: np.ndarray) -> Task:
        """The same from views that are planes of a slope (2,), depth over image coordinates at depth one.

        What would lie beyond the plane's horizon is put at ten times the depth of the middle.
        """
        image = self.completed.image
        nearness = np.maximum(1.0 - (image - image.mean(axis=1, keepdims=True)) @ slope, 0.1)
        return replace(self, completed=replace(self.completed, log_depth=-np.log(nearness)))

    def smoothed(self, shape: Shape) -> Task:
        """The same with arcs over surfaces that are smoothed over the corrected image points of a shape."""
        return replace(self, arcs=ArcSplines.over(self.completed.image + shape.correction))

    def spacing(self) -> float:
        """Median image length of the near edges."""
        near = self.mesh.edges[: self.mesh.n_near]
        image = self.completed.image
        return float(np.median(np.linalg.norm(image[:, near[:, 0]] - image[:, near[:, 1]], axis=-1)))

    def measurements(self, noise: Noise, conformal: bool, declared: bool = True) -> Measurements:
        """Measurements under given noise levels, with or without what is known of views declared isometric."""
        config, start = self.config, start_shape(self.completed, self.mesh)
        looseness = np.broadcast_to(noise.looseness, start.log_length.shape)
        if noise.turns and not conformal:
            shorter = np.exp(self.mesh.usual(start.log_length) - start.log_length)
            looseness = looseness * np.maximum(1.0, _SHORT * shorter) ** 2
        patches = 0.0 if conformal else PER_PATCH * noise.patches
        return Measurements(
            image=self.completed.image,
            image_weight=noise.image_weight(self.seen, self.completed.deviation),
            log_depth=start.log_depth,
            log_length=start.log_length,
            log_length_weight=np.full(len(start.log_length), 0.0 if conformal else noise.prior),
            length_weight=np.tile(1.0 / (noise.length * looseness), (len(self.seen), 1)),
            factor_weight=np.where(self.declared & declared, _DECLARED_FACTOR, _FACTOR),
            strain_weight=1.0 / config.strain_sigma,
            mesh=self.mesh,
            frontal=patches / looseness / (1.0 / looseness).sum(),
            weights=Weights(
                huber=noise.huber,
                bending=1.0 / config.bending_sigma if config.bending else 0.0,
                smoothness=1.0 / config.factor_sigma,
                drift=_DRIFT,
                unit=_UNIT,
            ),
            arcs=self.arcs,
        )


@dataclass(frozen=True)
class Fit:
    """A shape that fits the measurements, and how it was found."""

    measurements: Measurements
    shape: Shape
    noise: Noise
    history: list[float]
    """Cost at the start and after every iteration, run after run."""
    first_cost: float
    """Cost of the best shape under the noise levels of the start."""
    noisy: bool = True
    """Whether the ray corrections look like noise."""
    length_doubt: float = 1.0
    """So many times larger the length noise might be for all that points left out say; deviations are stated for it."""
    evidence: dict[str, Any] = field(default_factory=dict)
    """What the choices rest on."""
    ambiguity: Ambiguity | None = None
    """Which views may be inverted; None in an isometric model."""
    alternative: Shape | None = None
    """The shape with all ambiguous views inverted."""

    @property
    def conformal(self) -> bool:
        return self.shape.log_factor.size > 0

    def residuals(self) -> np.ndarray:
        """(F, E) length residuals."""
        envelope = self.measurements.envelope(self.conformal)
        return linearise(self.measurements, self.shape, lag(self.measurements, self.shape), envelope)[1]

    def doubted(self, measurements: Measurements) -> Measurements:
        """Measurements with lengths held only as tightly as is beyond doubt, for deviations."""
        return replace(measurements, length_weight=measurements.length_weight / self.length_doubt)

    def misfit(self) -> float:
        """Squared residuals of an isometric fit in assumed variances, on average over its degrees of freedom."""
        (F, P), E = self.shape.log_depth.shape, len(self.shape.log_length)
        return 2.0 * self.first_cost / max(F * E - F * P - E, 1)

    def corrections_in_common(self, seen: np.ndarray) -> tuple[float, float]:
        """Correlation of neighbours' ray corrections where seen (F, P), and its standard error if independent."""
        return neighbour_correlation(self.shape.correction, seen, self.measurements.mesh)

    def looks_like_noise(self, task: Task) -> bool:
        """Whether neighbours' ray corrections are independent."""
        correlation, chance = self.corrections_in_common(task.seen)
        return correlation <= chance


def minimised(task: Task, measurements: Measurements, shape: Shape) -> tuple[Shape, list[float]]:
    """The minimum from a shape, and the costs on the way."""
    return minimise(measurements, shape, task.config.iterations, task.config.tolerance)


def to_the_end(found: Fit) -> Fit:
    """A fit with its last steps, which are small and many where tracks tell little or lengths are held tightly."""
    shape, more = minimise(found.measurements, found.shape, *_CLOSE, closely=True)
    return replace(found, shape=shape, history=found.history + more)


def refitted(task: Task, found: Fit, noise: Noise) -> Fit:
    """A fit again, under other noise levels."""
    measurements = task.measurements(noise, conformal=found.conformal)
    shape, history = minimised(task, measurements, found.shape)
    return replace(found, measurements=measurements, shape=shape, noise=noise, history=found.history + history)
