"""The batched solver takes the step that GTSAM takes on the same factors."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.refine import solve
from connrsfm_graph.refine.cost import Weights
from connrsfm_graph.refine.elimination import Factorised
from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag, linearise, moved, total_cost
from connrsfm_graph.refine.memory import Memory
from connrsfm_graph.refine.mesh import surface_mesh
from connrsfm_graph.refine.solve import fit_views
from factors.adapter import make_factor
from factors.bending import Bending
from factors.edge_length import edge_length_factor
from factors.frontal import frontal_factor
from factors.image_point import image_point_factor
from factors.keys import LOG_DEPTH, LOG_FACTOR, LOG_LENGTH, RAY_CORRECTION, STRAIN, key
from factors.scale_smoothness import scale_smoothness_factor

F, P = 3, 9
MODELS = [(False, False), (True, False), (False, True)]
"""Conformal, strained."""


def _random_problem(
    conformal: bool, bending: bool, seed: int = 0, frontal: float = 0.7, strained: bool = False
) -> tuple[Measurements, Shape]:
    rng = np.random.default_rng(seed)
    image = rng.uniform(-0.5, 0.5, (1, P, 2)) + rng.normal(0, 0.05, (F, P, 2))
    mesh = surface_mesh(image[0], lambda edges: np.zeros(len(edges)))
    E = len(mesh.edges)
    shape = Shape(
        rng.normal(0.5, 0.1, (F, P)),
        rng.normal(0, 0.01, (F, P, 2)),
        rng.normal(0, 0.1, (F, P if conformal else 0)),
        rng.normal(-0.7, 0.3, E),
        rng.normal(0, 0.2, (F, 2 if strained else 0)),
    )
    measurements = Measurements(
        image=image,
        image_weight=rng.uniform(50, 100, (F, P)),
        log_depth=shape.log_depth - rng.normal(0, 0.1, (F, P)),
        log_length=shape.log_length - rng.normal(0, 0.1, E),
        log_length_weight=rng.uniform(2, 5, E),
        length_weight=rng.uniform(5, 10, (F, E)),
        factor_weight=rng.uniform(0.1, 1, F),
        strain_weight=4.0,
        mesh=mesh,
        frontal=frontal * rng.uniform(0.5, 1, E),
        weights=Weights(huber=1.0, bending=0.5 * bending, smoothness=5.0, drift=1.0, unit=0.0),
    )
    return measurements, shape


def _graph(
    measurements: Measurements, shape: Shape, more: np.ndarray | float = 0.0
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All factors; the residuals of lengths `more` (F, E) than they are."""
    more = np.broadcast_to(more, (F, len(shape.log_length)))
    mesh, weights, lagged = measurements.mesh, measurements.weights, lag(measurements, shape)
    conformal, strained = shape.log_factor.size > 0, shape.strain.size > 0
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def sigma(dimension: int, weight: float) -> gtsam.noiseModel.Isotropic:
        return gtsam.noiseModel.Isotropic.Sigma(dimension, 1.0 / weight)

    loss = gtsam.noiseModel.mEstimator.Huber.Create(weights.huber)
    for e, log_length in enumerate(shape.log_length):
        values.insert(key(LOG_LENGTH, e), np.array([log_length]))
        graph.add(
            gtsam.PriorFactorVector(
                key(LOG_LENGTH, e), measurements.log_length[e : e + 1], sigma(1, measurements.log_length_weight[e])
            )
        )
    for j in range(F):
        image = measurements.image[j]
        if strained:
            values.insert(key(STRAIN, 0, j), shape.strain[j])
            prior = sigma(2, measurements.strain_weight)
            graph.add(gtsam.PriorFactorVector(key(STRAIN, 0, j), np.zeros(2), prior))
        for i in range(P):
            values.insert(key(LOG_DEPTH, i, j), shape.log_depth[j, i : i + 1])
            values.insert(key(RAY_CORRECTION, i, j), shape.correction[j, i])
            graph.add(image_point_factor(i, j, sigma(2, measurements.image_weight[j, i])))
            prior = measurements.log_depth[j, i : i + 1]
            graph.add(gtsam.PriorFactorVector(key(LOG_DEPTH, i, j), prior, sigma(1, weights.drift)))
            if conformal:
                values.insert(key(LOG_FACTOR, i, j), shape.log_factor[j, i : i + 1])
                weight = measurements.factor_weight[j]
                graph.add(gtsam.PriorFactorVector(key(LOG_FACTOR, i, j), np.zeros(1), sigma(1, weight)))
        for e, (i, k) in enumerate(mesh.edges):
            noise = gtsam.noiseModel.Robust.Create(loss, sigma(1, measurements.length_weight[j, e]))
            offset = lagged.offset[j, e] + more[j, e]
            direction = tuple(mesh.direction[e]) if strained else None
            graph.add(edge_length_factor(e, i, k, j, image[i], image[k], noise, offset, conformal, direction))
            graph.add(frontal_factor(e, i, k, j, image[i], image[k], measurements.frontal[e]))
            if conformal and e < mesh.n_near:
                graph.add(scale_smoothness_factor(i, k, j, sigma(1, weights.smoothness)))
        if weights.bending > 0:
            for hinge, stencil in zip(mesh.hinges, lagged.stencils, strict=True):
                keys = [k for i in hinge for k in (key(LOG_DEPTH, i, j), key(RAY_CORRECTION, i, j))]
                graph.add(make_factor(Bending(stencil, image[hinge]), keys, [1, 2] * 4, sigma(3, weights.bending)))
    return graph, values


@pytest.mark.parametrize(("conformal", "strained"), MODELS)
@pytest.mark.parametrize("bending", [False, True])
@pytest.mark.parametrize("frontal", [0.0, 0.7])
def test_cost_and_step_equal_gtsams(conformal, strained, bending, frontal):
    measurements, shape = _random_problem(conformal, bending, frontal=frontal, strained=strained)
    graph, values = _graph(measurements, shape)
    lagged = lag(measurements, shape)
    assert total_cost(measurements, shape, lagged) == pytest.approx(graph.error(values), rel=1e-12)
    envelope = measurements.envelope(conformal)
    equations, _ = linearise(measurements, shape, lagged, envelope)
    step = Factorised(equations, envelope, measurements.mesh.edges).step(tolerance=1e-13)
    ours = moved(shape, envelope, *step)
    theirs = values.retract(graph.linearize(values).optimize())
    for j in range(F):
        for i in range(P):
            assert ours.log_depth[j, i] == pytest.approx(theirs.atVector(key(LOG_DEPTH, i, j))[0], abs=1e-10)
            assert ours.correction[j, i] == pytest.approx(theirs.atVector(key(RAY_CORRECTION, i, j)), abs=1e-10)
            if conformal:
                assert ours.log_factor[j, i] == pytest.approx(theirs.atVector(key(LOG_FACTOR, i, j))[0], abs=1e-10)
    for e in range(len(shape.log_length)):
        assert ours.log_length[e] == pytest.approx(theirs.atVector(key(LOG_LENGTH, e))[0], abs=1e-10)
    for j in range(F * strained):
        assert ours.strain[j] == pytest.approx(theirs.atVector(key(STRAIN, 0, j)), abs=1e-10)


@pytest.mark.parametrize(("conformal", "strained"), MODELS)
def test_a_correction_is_by_what_gtsams_step_changes(conformal, strained):
    measurements, shape = _random_problem(conformal, bending=True, strained=strained)
    measurements = replace(measurements, weights=measurements.weights._replace(huber=1e9))
    missed = np.random.default_rng(1).normal(0, 0.1, (F, len(shape.log_length)))
    steps = []
    for more in (missed, 0.0):
        graph, values = _graph(measurements, shape, more)
        steps.append(graph.linearize(values).optimize())
    envelope = measurements.envelope(conformal)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    factorised = Factorised(equations, envelope, measurements.mesh.edges)
    ours = moved(shape, envelope, *factorised.correction(missed, tolerance=1e-13))
    for j in range(F):
        for i in range(P):
            depth = key(LOG_DEPTH, i, j)
            expected = shape.log_depth[j, i] + (steps[0].at(depth) - steps[1].at(depth))[0]
            assert ours.log_depth[j, i] == pytest.approx(expected, abs=1e-10)
    for e in range(len(shape.log_length)):
        length = key(LOG_LENGTH, e)
        expected = shape.log_length[e] + (steps[0].at(length) - steps[1].at(length))[0]
        assert ours.log_length[e] == pytest.approx(expected, abs=1e-10)
    for j in range(F * strained):
        strain = key(STRAIN, 0, j)
        assert ours.strain[j] == pytest.approx(shape.strain[j] + steps[0].at(strain) - steps[1].at(strain), abs=1e-10)


@pytest.mark.parametrize(("conformal", "strained"), MODELS)
def test_what_a_step_misses_is_of_second_order(conformal, strained):
    measurements, shape = _random_problem(conformal, bending=False, strained=strained)
    envelope = measurements.envelope(conformal)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    direction = np.random.default_rng(2).normal(0, 1e-3, equations.gradient.shape)
    sizes = []
    for part in (1.0, 0.5):
        trial = moved(shape, envelope, part * direction, 1e-3 * part)
        sizes.append(np.abs(solve._missed(measurements, shape, trial, equations)))
    assert sizes[0].max() > 1e-8
    assert np.median(sizes[0] / sizes[1]) == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize(("conformal", "strained"), MODELS)
def test_the_schur_complement_is_symmetric_and_positive_definite(conformal, strained):
    measurements, shape = _random_problem(conformal, bending=True, seed=1, strained=strained)
    measurements = replace(measurements, weights=measurements.weights._replace(unit=10.0))
    envelope = measurements.envelope(conformal)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    factorised = Factorised(equations, envelope, measurements.mesh.edges, damping=0.1)
    S = factorised.schur_product(np.eye(len(measurements.mesh.edges) + shape.strain.size))
    assert pytest.approx(S.T, abs=1e-9 * np.abs(S).max()) == S
    assert np.linalg.eigvalsh(S).min() > 0


@pytest.mark.parametrize(("conformal", "strained"), MODELS)
def test_views_fitted_one_by_one_take_the_steps_of_the_whole_problem_with_lengths_held(conformal, strained):
    measurements, shape = _random_problem(conformal, bending=True, seed=2, strained=strained)
    envelope, lagged = measurements.envelope(conformal), lag(measurements, shape)
    equations, _ = linearise(measurements, shape, lagged, envelope)
    factorised = Factorised(equations, envelope, measurements.mesh.edges, damping=1e-3)
    step = moved(shape, envelope, -factorised.solve_views(equations.gradient[None])[0], 0.0)
    better = np.flatnonzero(costs(measurements, step, lagged) <= costs(measurements, shape, lagged))
    assert len(better)
    found, cost = fit_views(measurements, shape, iterations=1, tolerance=0.0)
    expected = shape.replaced(better, step.views(better))
    for name in ("log_depth", "correction", "log_factor"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-9, abs=1e-12)
    assert cost == pytest.approx(costs(measurements, found, lag(measurements, found)), rel=1e-12)
    alone, _ = fit_views(measurements.views(np.array([1])), shape.views(np.array([1])), iterations=1, tolerance=0.0)
    assert np.array_equal(alone.log_depth[0], found.log_depth[1])


def test_a_matrix_that_is_not_positive_definite_is_named():
    measurements, shape = _random_problem(conformal=False, bending=False)
    envelope = measurements.envelope(False)
    equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
    equations.matrix[1] *= -1.0
    with pytest.raises(ComputationError, match="normal equations of a view are not positive definite"):
        Factorised(equations, envelope, measurements.mesh.edges)


@pytest.mark.parametrize(("conformal", "strained"), MODELS)
def test_the_preconditioner_is_the_inverse_where_depths_are_held_and_views_agree(conformal, strained):
    measurements, shape = _random_problem(conformal, bending=False, seed=4, frontal=0.0, strained=strained)
    alike = np.zeros(F, dtype=int)
    held = replace(
        measurements.views(alike),
        log_length_weight=np.zeros(len(shape.log_length)),
        factor_weight=np.full(F, 1e6),
        strain_weight=1e6,
        weights=measurements.weights._replace(drift=1e6, huber=1e9),
    )
    shape, envelope = shape.views(alike), held.envelope(conformal)
    equations, _ = linearise(held, shape, lag(held, shape), envelope)
    factorised = Factorised(equations, envelope, held.mesh.edges)
    E = len(held.mesh.edges)
    product = factorised.schur_product(factorised.roughly_solved(np.eye(len(factorised.diagonal))))
    np.testing.assert_allclose(product[:E, :E], np.eye(E), atol=1e-6)


@pytest.fixture
def products(monkeypatch) -> list[int]:
    """Right-hand sides of every product with a Schur complement."""
    made, product = [], Factorised.schur_product
    monkeypatch.setattr(Factorised, "schur_product", lambda self, v: made.append(len(v)) or product(self, v))
    return made


def test_solutions_are_the_same_with_a_memory_and_take_fewer_products(products):
    measurements, shape = _random_problem(conformal=False, bending=False, seed=3, frontal=0.0)
    envelope, edges = measurements.envelope(False), measurements.mesh.edges
    lengths, counts = [], []
    for memory in (Memory(), remembering := Memory(), remembering):
        equations, _ = linearise(measurements, shape, lag(measurements, shape), envelope)
        products.clear()
        lengths.append(Factorised(equations, envelope, edges, damping=1e-3, memory=memory).step(1e-10)[1])
        counts.append(len(products))
    assert counts[2] < 0.5 * counts[0] == 0.5 * counts[1]
    assert lengths[2] == pytest.approx(lengths[0], abs=1e-7 * np.abs(lengths[0]).max())
