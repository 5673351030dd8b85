"""Fits of the isometric and of the conformal model, and the choice between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from connrsfm_graph.refine.ambiguity import Ambiguity, resolve
from connrsfm_graph.refine.config import RefineConfig
from connrsfm_graph.refine.cost import Weights
from connrsfm_graph.refine.held_out import prediction_errors, predicts_better
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.noise import Noise, neighbour_correlation
from connrsfm_graph.refine.restarts import inverted, restart
from connrsfm_graph.refine.solve import Measurements, Shape, costs, lag, linearise, minimise
from connrsfm_graph.refine.start import start_mesh, start_shape
from connrsfm_graph.refine.unseen import Completed

_UNIT = 1e3
"""Inverse standard deviation of the mean log length."""
_DRIFT = 0.3
"""Inverse standard deviation of log depths about their start."""
_FACTOR = 0.1
"""Inverse standard deviation of log conformal factors."""
_DECLARED_FACTOR = 1e3
"""The same for views declared isometric."""
_ROUNDS = 3
"""Fits with noise levels that the one before has shown, at most."""
_HALVINGS = 2
"""How often the assumed length noise may be halved."""
_RESTARTS = 4
"""Rounds of restarts, at most."""
_SUSPECT = (1.5, 0.02)
"""So may one of an isometric fit that costs so many times the lower quartile of the views, and so much per edge."""
_PROMISING = 2.0
"""Views of a second fit are restarted where it costs at most this many times the first."""
_MISFIT = 1.0
"""Isometry is in doubt where its squared residuals exceed this many assumed variances on average."""
_BEYOND_DOUBT = 0.05
"""A fit that leaves less than this is right, whatever its ray corrections look like."""
_DOUBT = 0.15
"""The same for the conformal model, which bends to many a wrong shape: its fit is then repeated from flat views."""
_RATIO = 6.0
"""The conformal model must then lower the cost by this factor: its many unknowns alone already gain a lot."""


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

    @staticmethod
    def of(completed: Completed, seen: np.ndarray, config: RefineConfig) -> Task:
        """With the mesh of the start."""
        return Task(completed, seen, start_mesh(completed, seen, config.rings), config)

    @property
    def declared(self) -> np.ndarray:
        """(F,) bool, views declared isometric to each other."""
        return np.isin(np.arange(len(self.seen)), self.config.isometric_views)

    def spacing(self) -> float:
        """Median image length of the near edges."""
        near = self.mesh.edges[: self.mesh.n_near]
        image = self.completed.image
        return float(np.median(np.linalg.norm(image[:, near[:, 0]] - image[:, near[:, 1]], axis=-1)))

    def measurements(self, noise: Noise, conformal: bool, declared: bool = True) -> Measurements:
        """Measurements under given noise levels, with or without what is known of views declared isometric."""
        config, start = self.config, start_shape(self.completed, self.mesh)
        return Measurements(
            image=self.completed.image,
            image_weight=noise.image_weight(self.seen, self.completed.deviation),
            log_depth=start.log_depth,
            log_length=start.log_length,
            log_length_weight=np.full(len(start.log_length), 0.0 if conformal else noise.prior),
            length_weight=np.full((len(self.seen), len(self.mesh.edges)), 1.0 / noise.length),
            factor_weight=np.where(self.declared & declared, _DECLARED_FACTOR, _FACTOR),
            mesh=self.mesh,
            weights=Weights(
                huber=noise.huber,
                bending=1.0 / config.bending_sigma if config.bending else 0.0,
                smoothness=1.0 / config.factor_sigma,
                drift=_DRIFT,
                unit=_UNIT,
            ),
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
    misfit = _misfit(isometric)
    isometric.evidence["isometric misfit"] = misfit
    if wanted == "isometric" or misfit <= _MISFIT:
        return isometric
    conformal = fit_conformal(task, noise)
    ratio = isometric.first_cost / max(conformal.first_cost, 1e-300)
    for found in (isometric, conformal):
        found.evidence["isometric misfit"] = misfit
        found.evidence["isometric over conformal cost"] = ratio
    return conformal if ratio > _RATIO else isometric


def _misfit(found: Fit) -> float:
    """Squared residuals of an isometric fit in assumed variances, on average over its degrees of freedom."""
    (F, P), E = found.shape.log_depth.shape, len(found.shape.log_length)
    return 2.0 * found.first_cost / max(F * E - F * P - E, 1)


def fit_isometric(task: Task, noise: Noise) -> Fit:
    """Isometric fit from the start and, where that leaves a doubt, from flat views; the cheaper one stays."""
    found = _from_start(task, noise)
    misfit = _misfit(found)
    if misfit > _MISFIT or (misfit > _BEYOND_DOUBT and not _looks_like_noise(task, found)):
        # The surface may stretch, or the start may be to blame for all views alike; flat ones are neutral.
        flat = replace(task, completed=replace(task.completed, log_depth=np.zeros_like(task.completed.log_depth)))
        again = _from_start(flat, noise, _PROMISING * found.first_cost)
        if again.first_cost < found.first_cost:
            task, found = flat, again
    return _settled(task, found)


def _from_start(task: Task, noise: Noise, worth: float = np.inf) -> Fit:
    """Isometric fit; where it costs less than `worth`, views that cost more than others try other starts until none
    gains."""
    measurements = task.measurements(noise, conformal=False)
    shape, history = _minimise(task, measurements, start_shape(task.completed, task.mesh))
    factor, per_edge = _SUSPECT
    for _ in range(_RESTARTS if history[-1] < worth else 0):
        cost = costs(measurements, shape, lag(measurements, shape))
        suspect = np.flatnonzero(cost > max(factor * np.quantile(cost, 0.25), per_edge * len(task.mesh.edges)))
        if len(suspect) == 0:
            break
        better, renewed = restart(measurements.views(suspect), shape.views(suspect))
        if not renewed.any():
            break
        shape, more = _minimise(task, measurements, shape.replaced(suspect, better))
        history += more
    return Fit(measurements, shape, noise, history, history[-1])


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
    shape, more = _minimise(task, measurements, shape)
    history += more
    alternative = None
    if ambiguity.group.any():
        alternative, other = _minimise(task, measurements, inverted(shape, measurements.image, ambiguity.group > 0))
        # Where one inversion is common to several undecided views, the conformal factors decide which varies less.
        if np.count_nonzero(ambiguity.group == 1) > 1 and other[-1] < history[-1]:
            shape, alternative = alternative, shape
            history += other
    found = _settled(task, Fit(measurements, shape, noise, history, history[-1]))
    found.evidence["conformal factors rest on"] = ambiguity.assumption
    found.evidence["views that might be inverted"] = np.flatnonzero(ambiguity.group).tolist()
    return replace(found, ambiguity=ambiguity, alternative=alternative)


def _restarted(task: Task, measurements: Measurements, shape: Shape) -> tuple[Shape, list[float]]:
    """Minimum from a shape, all views restarted until none gains, and the costs on the way."""
    shape, history = _minimise(task, measurements, shape)
    for _ in range(_RESTARTS):
        shape, renewed = restart(measurements, shape)
        if not renewed.any():
            break
        shape, more = _minimise(task, measurements, shape)
        history += more
    return shape, history


def _minimise(task: Task, measurements: Measurements, shape: Shape) -> tuple[Shape, list[float]]:
    return minimise(measurements, shape, task.config.iterations, task.config.tolerance)


def _settled(task: Task, found: Fit) -> Fit:
    """The fit with the noise levels that the data show.

    Where the ray corrections look like noise, the image noise stands and the lengths are trusted more, as long as that
    predicts image points better. Where they do not, the image noise was assumed too large, as long as that leaves the
    shared lengths where they are: what little noise is left would else crumple all views alike.
    """
    noisy = _looks_like_noise(task, found)
    if noisy:
        found = _trusting_lengths(task, found)
    for _ in range(_ROUNDS):
        noise = found.noise.after_fit(found.residuals())
        if not noisy:
            noise = noise.lowered_image(found.shape.correction[task.seen])
        if noise.settled(found.noise):
            break
        again = _refitted(task, found, noise)
        freed = noise.release > found.noise.release and not task.seen.all()  # which moves lengths for a good reason
        moved = float(np.median(np.abs(again.shape.log_length - found.shape.log_length)))
        if noise.image < found.noise.image and moved > noise.length and not freed:
            break
        found = again
    found.evidence.update(_noise_evidence(task, found))
    return replace(found, noisy=noisy)


def _trusting_lengths(task: Task, found: Fit) -> Fit:
    """The fit with half the length noise, or a quarter, as long as points left out are predicted better."""
    if _misfit(found) < _BEYOND_DOUBT:
        return found
    errors = prediction_errors(found.measurements, found.shape, task.seen)
    for _ in range(_HALVINGS):
        trial = _refitted(task, found, found.noise.halved_length())
        new = prediction_errors(trial.measurements, trial.shape, task.seen)
        if not predicts_better(new, errors):
            break
        found, errors = trial, new
    return found


def _looks_like_noise(task: Task, found: Fit) -> bool:
    correlation, error = neighbour_correlation(found.shape.correction, task.seen, task.mesh)
    return correlation <= error


def _refitted(task: Task, found: Fit, noise: Noise) -> Fit:
    measurements = task.measurements(noise, conformal=found.conformal)
    shape, history = _minimise(task, measurements, found.shape)
    return replace(found, measurements=measurements, shape=shape, noise=noise, history=found.history + history)


def _noise_evidence(task: Task, found: Fit) -> dict[str, Any]:
    noise, correction = found.noise, found.shape.correction
    return {
        "image noise": noise.image,
        "image noise over image length of an edge": float(np.sqrt(2.0)) * noise.image / noise.spacing,
        "length noise": noise.length,
        "root mean square ray correction": float(np.sqrt((correction[task.seen] ** 2).mean())),
        "correlation of neighbours' ray corrections": neighbour_correlation(correction, task.seen, task.mesh)[0],
        "median absolute length residual": float(np.median(np.abs(found.residuals()))),
        "bending": task.config.bending,
    }
