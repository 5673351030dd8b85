"""What the refinement estimates, what that is compared with, its cost and its normal equations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from connrsfm_graph.refine.arcs import ArcSplines, arc_offset_kernel
from connrsfm_graph.refine.cost import Terms, Weights, cost_kernel, hinge_stencils, linearise_kernel
from connrsfm_graph.refine.elimination import NormalEquations
from connrsfm_graph.refine.envelope import Envelope, make_envelope
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.stretch import stretches
from connrsfm_graph.threads import over_views

OF_VIEWS = ("log_depth", "correction", "log_factor", "strain")
"""Parts of a shape that belong to single views."""


@dataclass(frozen=True)
class Shape:
    """What is estimated."""

    log_depth: np.ndarray
    """(F, P)."""
    correction: np.ndarray
    """(F, P, 2) corrections of the sight rays, normalised coordinates."""
    log_factor: np.ndarray
    """(F, P) log conformal factors; (F, 0) in an isometric model."""
    log_length: np.ndarray
    """(E,) lengths shared by all views."""
    strain: np.ndarray
    """(F, 2) homogeneous strains of the views; (F, 0) where they are not stretched, as in every conformal model."""

    def points(self, image: np.ndarray) -> np.ndarray:
        """(F, P, 3) points in the camera frames, for tracked image points (F, P, 2)."""
        depth = np.exp(self.log_depth)[..., None]
        return np.concatenate([depth * (image + self.correction), depth], axis=-1)

    def views(self, index: np.ndarray) -> Shape:
        """The shape of some views."""
        return replace(self, **{name: getattr(self, name)[index] for name in OF_VIEWS})

    def replaced(self, index: np.ndarray, other: Shape) -> Shape:
        """The shape with some views taken from a shape of only these."""
        parts = {name: getattr(self, name).copy() for name in OF_VIEWS}
        for name, part in parts.items():
            part[index] = getattr(other, name)
        return replace(self, **parts)


@dataclass(frozen=True)
class Measurements:
    """What the shape is compared with."""

    image: np.ndarray
    """(F, P, 2) image points, normalised coordinates; finite everywhere, interpolated where not seen."""
    image_weight: np.ndarray
    """(F, P) inverse standard deviation of the image points."""
    log_depth: np.ndarray
    """(F, P) log depths of the start, about which those of the shape may drift."""
    log_length: np.ndarray
    """(E,) log lengths of the start, likewise; it keeps a part that hardly moves from coming off the surface."""
    log_length_weight: np.ndarray
    """(E,) their inverse standard deviation."""
    length_weight: np.ndarray
    """(F, E) inverse standard deviation of the log lengths."""
    factor_weight: np.ndarray
    """(F,) inverse standard deviation of the log conformal factors of a view; not used in an isometric model."""
    strain_weight: float
    """Inverse standard deviation of the two numbers of a view's strain; not used where views are not stretched."""
    mesh: Mesh
    """Edges and hinges."""
    frontal: np.ndarray
    """(E,) cost of an edge's log foreshortening in a view, no standard deviation; zero where slants are not assumed
    small."""
    weights: Weights
    """Inverse standard deviations of the other terms."""
    arcs: ArcSplines | None = None
    """What surfaces are smoothed by before arcs are measured over them; None where they are not."""

    def envelope(self, conformal: bool) -> Envelope:
        """Storage of the views' matrices."""
        return make_envelope(self.mesh.order(), [self.mesh.edges, self.mesh.hinges], 4 if conformal else 3)

    def views(self, index: np.ndarray) -> Measurements:
        """The measurements of some views."""
        return replace(
            self,
            image=self.image[index],
            image_weight=self.image_weight[index],
            log_depth=self.log_depth[index],
            length_weight=self.length_weight[index],
            factor_weight=self.factor_weight[index],
            arcs=None if self.arcs is None else self.arcs.views(index),
        )

    def replaced(self, index: np.ndarray, other: Measurements) -> Measurements:
        """The measurements with some views taken from measurements of only these."""
        names = ("image", "image_weight", "log_depth", "length_weight", "factor_weight")
        parts = {name: getattr(self, name).copy() for name in names}
        for name, part in parts.items():
            part[index] = getattr(other, name)
        arcs = None if self.arcs is None or other.arcs is None else self.arcs.replaced(index, other.arcs)
        return replace(self, **parts, arcs=arcs)

    def splines(self) -> ArcSplines:
        """As compiled code takes them."""
        return ArcSplines.none(len(self.image)) if self.arcs is None else self.arcs


@dataclass(frozen=True)
class Lagged:
    """Functions of the shape that are held fixed in its derivatives."""

    offset: np.ndarray
    """(F, E) log ratio of arc to chord."""
    stencils: np.ndarray
    """(H, 4) coefficients of the hinges."""


def lag(measurements: Measurements, shape: Shape) -> Lagged:
    """Hinge coefficients and arc offsets at a shape.

    A conformal model compares chords: Moebius maps keep their ratios exactly, not those of arcs.
    """
    mesh, stencils = measurements.mesh, stencils_of(measurements, shape)
    points = shape.points(measurements.image)
    offset = np.zeros((len(points), len(mesh.edges)))
    if shape.log_factor.size:
        return Lagged(offset, stencils)
    over_views(arc_offset_kernel, len(points), points, mesh.triangles, mesh.edges, measurements.splines(), offset)
    return Lagged(offset, stencils)


def stencils_of(measurements: Measurements, shape: Shape) -> np.ndarray:
    """(H, 4) hinge coefficients at a shape; zero where bending is free."""
    stencils = np.zeros((len(measurements.mesh.hinges), 4))
    if measurements.weights.bending > 0.0:
        hinge_stencils(np.exp(shape.log_length), measurements.mesh.hinge_edges, stencils)
    return stencils


def costs(measurements: Measurements, shape: Shape, lagged: Lagged) -> np.ndarray:
    """(F,) cost of every view, see `view_cost`."""
    cost = np.empty(len(shape.log_depth))
    over_views(cost_kernel, len(cost), *kernel_arguments(measurements, shape, lagged), cost)
    return cost


def linearise(
    measurements: Measurements,
    shape: Shape,
    lagged: Lagged,
    envelope: Envelope,
    storage: np.ndarray | None = None,
) -> tuple[NormalEquations, np.ndarray]:
    """Normal equations at a shape, and the length residuals (F, E); `storage` is that of a matrix no longer needed."""
    F, _ = shape.log_depth.shape
    n, E = len(envelope.first), len(measurements.mesh.edges)
    matrix = np.empty((F, envelope.start[-1])) if storage is None else storage
    gradient = np.empty((F, n))
    border = np.empty((F, E, 8 if shape.log_factor.size else 6))
    residual, weight = np.empty((F, E)), np.empty((F, E))
    arguments = kernel_arguments(measurements, shape, lagged)
    over_views(linearise_kernel, F, *arguments, envelope, matrix, gradient, border, residual, weight)
    unit = measurements.weights.unit
    prior = measurements.log_length_weight**2
    _, by_strain = stretches(shape.strain, measurements.mesh)
    held = measurements.strain_weight**2
    equations = NormalEquations(
        matrix=matrix,
        gradient=gradient,
        border=border,
        by_strain=by_strain,
        weight=weight,
        unit=unit,
        length_weight=prior,
        length_gradient=unit**2 * shape.log_length.mean() / E
        + F * measurements.frontal
        + prior * (shape.log_length - measurements.log_length)
        - (weight * residual).sum(axis=0),
        strain_weight=held,
        ray_weight=(measurements.image_weight**2).sum(axis=0),
        strain_gradient=held * shape.strain - np.einsum("fe,fek->fk", weight * residual, by_strain),
    )
    return equations, residual


def kernel_arguments(measurements: Measurements, shape: Shape, lagged: Lagged) -> tuple:
    """What the kernels of the cost ask for."""
    change, _ = stretches(shape.strain, measurements.mesh)
    return (
        shape.points(measurements.image),
        shape.log_factor,
        shape.log_depth - measurements.log_depth,
        lagged.offset - change,
        shape.correction,
        measurements.image_weight,
        measurements.length_weight,
        measurements.factor_weight,
        terms_of(measurements, shape, lagged.stencils),
    )


def terms_of(measurements: Measurements, shape: Shape, stencils: np.ndarray) -> Terms:
    """What the kernels take as common to all views."""
    mesh, frontal = measurements.mesh, measurements.frontal
    return Terms(mesh.edges, mesh.n_near, mesh.hinges, stencils, shape.log_length, frontal, measurements.weights)


def moved(shape: Shape, envelope: Envelope, views: np.ndarray, border: np.ndarray | float) -> Shape:
    """The shape after a step: (F, n) of the views' unknowns and (E + F K,) of the lengths and the strains."""
    (F, P), E = shape.log_depth.shape, len(shape.log_length)
    lengths, strain = np.split(np.broadcast_to(border, E + shape.strain.size), [E])
    step = views.reshape(F, P, -1)[:, envelope.unknown // (views.shape[1] // P)]
    return Shape(
        log_depth=shape.log_depth + step[..., 0],
        correction=shape.correction + step[..., 1:3],
        log_factor=shape.log_factor + step[..., 3] if shape.log_factor.size else shape.log_factor,
        log_length=shape.log_length + lengths,
        strain=shape.strain + strain.reshape(shape.strain.shape),
    )


def total_cost(measurements: Measurements, shape: Shape, lagged: Lagged) -> float:
    """Cost of all views, and of the lengths' and the strains' own priors."""
    with np.errstate(over="ignore", invalid="ignore"):
        total = float(costs(measurements, shape, lagged).sum())
    drift = measurements.log_length_weight * (shape.log_length - measurements.log_length)
    total += 0.5 * (measurements.weights.unit * float(shape.log_length.mean())) ** 2 + 0.5 * float(drift @ drift)
    return total + 0.5 * float(((measurements.strain_weight * shape.strain) ** 2).sum())
