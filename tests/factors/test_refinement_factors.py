"""The refinement's factors: lengths, arcs, inversions and bending on shapes where the answer is known."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from factors.bending import bending_factor, hinge_coefficients
from factors.edge_length import EdgeLength, arc_offset, edge_length_factor, stretch_kernel
from factors.image_point import image_point_factor
from factors.keys import LOG_DEPTH, LOG_LENGTH, RAY_CORRECTION, key
from factors.scale_smoothness import scale_smoothness_factor

UNIT = gtsam.noiseModel.Unit.Create


def _variables(points: np.ndarray, image: np.ndarray) -> list[np.ndarray]:
    """Log depth and ray correction of each point (N, 3), in turn, for tracked image points (N, 2)."""
    pairs = [(np.log(x[2:]), x[:2] / x[2] - u) for x, u in zip(points, image, strict=True)]
    return [value for pair in pairs for value in pair]


def test_the_length_residual_is_log_chord_plus_offset_minus_latent_length():
    points = np.array([[0.3, -0.2, 2.0], [0.6, 0.2, 2.5]])
    image = points[:, :2] / points[:, 2:] + 0.01
    factor = EdgeLength(image[0], image[1], 0.02)
    b_i, q_i, b_k, q_k = _variables(points, image)
    residual = factor.residual(b_i, q_i, b_k, q_k, np.array([-0.4]))
    assert residual == pytest.approx([np.log(np.linalg.norm(points[0] - points[1])) + 0.02 + 0.4], abs=1e-14)


@given(st.integers(0, 10_000))
def test_inverting_a_view_about_the_camera_centre_changes_no_conformal_residual(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1, -1, 1), (1, 1, 3), (2, 3))
    image = points[:, :2] / points[:, 2:] + rng.normal(0, 0.01, (2, 2))
    f, e = rng.normal(0, 0.3, (2, 1)), rng.normal(0, 1, 1)
    squared = (points**2).sum(axis=1, keepdims=True)
    factor = EdgeLength(*image, 0.0)
    before = factor.residual(*_variables(points, image), e, *f)
    after = factor.residual(*_variables(points / squared, image), e, *(f - np.log(squared)))
    assert after == pytest.approx(before, abs=1e-12)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, np.pi))
def test_a_strain_stretches_edges_as_the_matrix_exponential_does(a, b, angle):
    edge = np.array([np.cos(angle), np.sin(angle)])
    stretched = expm(np.array([[a, b], [b, -a]])) @ edge
    change, _, _ = stretch_kernel(a, b, np.cos(2 * angle), np.sin(2 * angle))
    assert change == pytest.approx(np.log(np.linalg.norm(stretched)), abs=1e-9)


def test_an_edge_is_compared_up_to_conformal_factors_or_a_strain_not_both():
    with pytest.raises(ValueError, match="up to conformal factors or up to a strain, not both"):
        edge_length_factor(0, 0, 1, 0, np.zeros(2), np.ones(2), UNIT(1), conformal=True, direction=(1.0, 0.0))


@pytest.mark.parametrize("angle", [0.05, 0.2, 0.4])
def test_the_arc_offset_of_a_circle_is_right_to_second_order(angle):
    exact = np.log(angle / np.sin(angle))
    assert arc_offset(angle, -angle) == pytest.approx(exact, abs=0.01 * angle**4)


def test_a_flat_hinge_does_not_bend_however_it_is_placed():
    rng = np.random.default_rng(1)
    flat = np.array([[0.0, 0.0], [1.0, 0.1], [0.4, 0.9], [0.6, -0.7]])
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2]
    assert np.abs(_hinge_residual(flat @ frame.T + [0.2, -0.1, 5.0])).max() < 1e-13


def test_a_bent_hinge_shows_its_dihedral_angle():
    half, height = 0.5, 0.8
    residuals = []
    for angle in (0.1, 0.2):
        wing = height * np.array([np.cos(angle / 2), -np.sin(angle / 2)])
        corners = np.array([[-half, 0, 0], [half, 0, 0], [0, wing[0], wing[1]], [0, -wing[0], wing[1]]])
        points = corners + np.array([0, 0, 4])
        residuals.append(np.linalg.norm(_hinge_residual(points)))
    # |sum c X| = 2 |e| sin(angle / 2) for the symmetric hinge, times sqrt(3 / (A0 + A1)).
    expected = 2 * 2 * half * np.sin(0.05) * np.sqrt(3 / (2 * half * height))
    assert residuals[0] == pytest.approx(expected, rel=1e-12)
    assert residuals[1] == pytest.approx(2 * residuals[0], rel=1e-2)


def _hinge_residual(points: np.ndarray) -> np.ndarray:
    pairs = [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3)]
    coefficients = hinge_coefficients(*(float(np.linalg.norm(points[a] - points[b])) for a, b in pairs))
    return np.array(coefficients) @ points


def test_a_sliver_triangle_has_finite_coefficients():
    assert np.isfinite(hinge_coefficients(1.0, 0.4, 0.6, 0.5, 0.5)).all()


def test_the_same_factors_recover_a_triangle_in_a_users_graph():
    rng = np.random.default_rng(3)
    shape = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.2, 0.9, 0.0]])
    graph, values, truth = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    edges = [(0, 1), (1, 2), (0, 2)]
    sharp = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)
    for view in range(2):
        turn = gtsam.Rot3.RzRyRx(*rng.uniform(-0.5, 0.5, 3)).matrix()
        points = shape @ turn.T + [0, 0, 4]
        image = points[:, :2] / points[:, 2:]
        for e, (i, k) in enumerate(edges):
            graph.add(edge_length_factor(e, i, k, view, image[i], image[k], sharp))
        for i in range(3):
            graph.add(image_point_factor(i, view, gtsam.noiseModel.Isotropic.Sigma(2, 1e-4)))
            truth[key(LOG_DEPTH, i, view)] = np.log(points[i, 2])
            values.insert(key(LOG_DEPTH, i, view), np.log(points[i, 2:]) + rng.normal(0, 0.01, 1))
            values.insert(key(RAY_CORRECTION, i, view), np.zeros(2))
    for e, (i, k) in enumerate(edges):
        length = np.log([np.linalg.norm(shape[i] - shape[k])])
        values.insert(key(LOG_LENGTH, e), length)
        graph.add(gtsam.PriorFactorVector(key(LOG_LENGTH, e), length, sharp))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert max(abs(solved.atVector(k)[0] - z) for k, z in truth.items()) < 1e-6


def test_noise_of_the_wrong_dimension_is_named():
    with pytest.raises(ValueError, match="image point: noise model has dimension 1, expected 2"):
        image_point_factor(0, 0, UNIT(1))
    with pytest.raises(ValueError, match="scale smoothness: noise model has dimension 2, expected 1"):
        scale_smoothness_factor(0, 1, 0, UNIT(2))
    with pytest.raises(ValueError, match="bending: noise model has dimension 1, expected 3"):
        bending_factor(range(4), 0, np.zeros((4, 2)), np.ones(5), UNIT(1))
