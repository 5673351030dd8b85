"""Global refinement: all views together, up to what the surface can do, with the noise of the images in view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.refine.cost import Weights
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.solve import Measurements, Shape, lag, linearise, minimise
from connrsfm_graph.refine.start import start_mesh, start_shape
from connrsfm_graph.refine.unseen import Completed, complete
from connrsfm_graph.refine.wrong_tracks import wrong_tracks

_UNIT = 1e3
"""Inverse standard deviation of the mean log length."""
_ROUNDS = 4
"""Fits with noise levels that the one before has shown."""
_ATTEMPTS = 3
"""Fits without the tracks that the one before has shown to be wrong."""


@dataclass(frozen=True)
class RefineConfig:
    """Refinement over latent edge lengths shared by all views."""

    length_sigma: float = 0.01
    """Standard deviation of a log edge length in one view: what the surface stretches, and the mesh does not show."""
    rings: int = 2
    """Edges join points up to this distance in the triangulation, 1 or 2."""
    outliers: bool = True
    """Whether wrong tracks are looked for and replaced by what the other points and views say."""
    bending: bool = False
    """Whether surfaces are kept from bending. Latent lengths alone already keep noise from crumpling a surface."""
    bending_sigma: float = 8.0
    """Standard deviation of the hinges' curvature vectors relative to their size."""
    iterations: int = 30
    """Iterations of the joint solver at most."""
    tolerance: float = 1e-3
    """The solver stops where an iteration lowers the cost by less than this part."""

    def __post_init__(self) -> None:
        for name in ("length_sigma", "bending_sigma"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"refine.{name} is {getattr(self, name)}, expected a positive number")
        if self.rings not in (1, 2):
            raise InputError(f"refine.rings is {self.rings}, expected 1 or 2")
        if self.iterations < 1 or self.tolerance < 0.0:
            raise InputError("refine.iterations must be at least 1 and refine.tolerance at least 0")


@dataclass(frozen=True)
class Refined:
    """The refined surfaces and the evidence for how they were refined."""

    points: np.ndarray
    """(F, P, 3) camera frame of each view; also where a point was not seen. NaN where it was seen in no view."""
    log_depth: np.ndarray
    """(F, P)."""
    depth_std: np.ndarray
    """(F, P) standard deviation of depth, in the unit of depth."""
    ray_correction: np.ndarray
    """(F, P, 2) correction of the tracked image point, normalised coordinates; NaN where not seen."""
    log_factor: np.ndarray
    """(F, P) log conformal factor, zero in an isometric model."""
    log_length: np.ndarray
    """(E,) log lengths of the mesh's edges, shared by the views, mean zero."""
    mesh_edges: np.ndarray
    """(E, 2) points of each edge."""
    outlier: np.ndarray
    """(F, P) bool, observed but judged a wrong track."""
    model: Literal["isometric", "conformal"]
    """Which model was chosen."""
    evidence: Mapping[str, Any]
    """What the choices rest on."""
    cost_history: tuple[float, ...]
    """Cost at the start and after every iteration; starts anew where the assumed noise changed."""
    warnings: tuple[str, ...] = ()
    """One sentence each."""


def refine(
    image: np.ndarray,
    visible: np.ndarray,
    log_depth: np.ndarray,
    config: RefineConfig,
    sigma_image: float,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """Refine the depths of all views.

    Args:
        image: (F, P, 2) normalised coordinates, any value where not visible.
        visible: (F, P) bool.
        log_depth: (F, P) where to start, in any scale per view; NaN is interpolated from the other points of the view.
        config: settings.
        sigma_image: standard deviation of a coordinate of the image points, normalised; NaN where it is not known.
        progress: called with (done, total).

    Raises:
        InputError: arrays do not fit, or a view has nothing to start from.
    """
    image, visible, log_depth = _checked(image, visible, log_depth)
    outlier = wrong_tracks(image, visible) if config.outliers else np.zeros_like(visible)
    for _ in range(_ATTEMPTS):
        used = (visible & ~outlier).any(axis=0)
        seen = (visible & ~outlier)[:, used]
        completed = complete(image[:, used], seen, np.where(outlier, np.nan, log_depth)[:, used])
        fit = _fit(completed, seen, config, sigma_image)
        if not config.outliers:
            break
        late = np.zeros_like(visible)
        late[:, used] = fit.wrong
        if not late.any():
            break
        outlier |= late
    if progress is not None:
        progress(1, 1)
    return _refined(fit, seen, used, outlier)


@dataclass(frozen=True)
class _Fit:
    """A shape that fits all observations taken for right."""

    measurements: Measurements
    shape: Shape
    history: list[float]
    evidence: dict[str, Any]
    wrong: np.ndarray
    """(F, P) bool, observations that the shape contradicts."""


def _fit(completed: Completed, seen: np.ndarray, config: RefineConfig, sigma_image: float) -> _Fit:
    mesh = start_mesh(completed, seen, config.rings)
    shape = start_shape(completed, mesh)
    near = mesh.edges[: mesh.n_near]
    spacing = float(np.median(np.linalg.norm(completed.image[:, near[:, 0]] - completed.image[:, near[:, 1]], axis=-1)))
    noise = Noise.start(sigma_image, spacing)
    history: list[float] = []
    for _ in range(_ROUNDS):
        measurements = Measurements(
            image=completed.image,
            image_weight=noise.image_weight(seen, completed.deviation),
            length_weight=np.full((len(seen), len(mesh.edges)), 1.0 / config.length_sigma),
            mesh=mesh,
            weights=make_weights(config, noise.huber, bending=config.bending),
        )
        shape, costs = minimise(measurements, shape, config.iterations, config.tolerance)
        history += costs
        residual = linearise(measurements, shape, lag(measurements, shape), measurements.envelope(False))[1]
        last, noise = noise, noise.updated(shape.correction[seen], residual / config.length_sigma)
        if noise.settled(last):
            break
    correction = np.linalg.norm(shape.correction, axis=-1)
    evidence = {
        "image noise": noise.sigma,
        "image noise over image length of an edge": float(np.sqrt(2.0)) * noise.sigma / spacing,
        "root mean square ray correction": float(np.sqrt((shape.correction[seen] ** 2).mean())),
        "median absolute length residual": float(np.median(np.abs(residual))),
        "bending": config.bending,
    }
    return _Fit(measurements, shape, history, evidence, seen & (correction > noise.gross(correction[seen])))


def make_weights(config: RefineConfig, huber: float, bending: bool) -> Weights:
    """Weights of the cost's terms."""
    return Weights(
        huber=huber,
        bending=1.0 / config.bending_sigma if bending else 0.0,
        smoothness=0.0,
        factor=0.0,
        unit=_UNIT,
    )


def _checked(image: np.ndarray, visible: np.ndarray, log_depth: np.ndarray) -> tuple[np.ndarray, ...]:
    image, log_depth = np.asarray(image, dtype=float), np.asarray(log_depth, dtype=float)
    visible = np.asarray(visible, dtype=bool)
    if image.shape != (*visible.shape, 2) or log_depth.shape != visible.shape:
        raise InputError(
            f"refinement: image {image.shape}, visible {visible.shape} and log_depth {log_depth.shape} do not fit, "
            "expected (F, P, 2), (F, P) and (F, P)"
        )
    if not np.isfinite(image[visible]).all():
        raise InputError("refinement: an image point is NaN where 'visible' is true")
    if not visible.any(axis=1).all():
        raise InputError(f"refinement: image {int(visible.any(axis=1).argmin())} sees no point")
    return np.where(visible[..., None], image, 0.0), visible, log_depth


def _refined(fit: _Fit, seen: np.ndarray, used: np.ndarray, outlier: np.ndarray) -> Refined:
    def all_points(values: np.ndarray) -> np.ndarray:
        full = np.full((len(values), len(used), *values.shape[2:]), np.nan)
        full[:, used] = values
        return full

    measurements, shape = fit.measurements, fit.shape
    conformal = shape.log_factor.size > 0
    return Refined(
        points=all_points(shape.points(measurements.image)),
        log_depth=all_points(shape.log_depth),
        depth_std=np.full(outlier.shape, np.nan),
        ray_correction=all_points(np.where(seen[..., None], shape.correction, np.nan)),
        log_factor=all_points(shape.log_factor if conformal else np.zeros_like(shape.log_depth)),
        log_length=shape.log_length,
        mesh_edges=np.flatnonzero(used)[measurements.mesh.edges],
        outlier=outlier,
        model="conformal" if conformal else "isometric",
        evidence=fit.evidence,
        cost_history=tuple(fit.history),
    )
