"""The prior on slants: what it costs, that it is linear, and that it holds together with other factors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.edge_length import log_chord_kernel
from factors.frontal import frontal_factor, log_foreshortening_kernel
from factors.keys import LOG_DEPTH, LOG_LENGTH, key

IMAGE = np.array([[0.1, -0.2], [0.14, -0.17]])
KEYS = key(LOG_DEPTH, 0, 3), key(LOG_DEPTH, 1, 3), key(LOG_LENGTH, 2)


def _values(*x: float) -> gtsam.Values:
    values = gtsam.Values()
    for k, one in zip(KEYS, x, strict=True):
        values.insert(k, np.array([one]))
    return values


def _factor(weight: float) -> gtsam.LinearContainerFactor:
    return frontal_factor(2, 0, 1, 3, *IMAGE, weight)


def test_a_frontal_edge_costs_nothing_and_a_longer_one_the_logarithm_of_how_much():
    apart = np.log(np.linalg.norm(IMAGE[0] - IMAGE[1]))
    assert _factor(5.0).error(_values(0.7, 0.7, 0.7 + apart)) == pytest.approx(0.0, abs=1e-14)
    assert _factor(5.0).error(_values(0.7, 0.7, 0.8 + apart)) == pytest.approx(0.5, abs=1e-13)
    assert _factor(5.0).error(_values(0.8, 0.7, 0.7 + apart)) == pytest.approx(-0.25, abs=1e-13)


def test_points_at_one_place_cost_a_finite_number():
    assert np.isfinite(frontal_factor(2, 0, 1, 3, IMAGE[0], IMAGE[0], 1.0).error(_values(0.0, 0.0, 0.0)))


@pytest.mark.parametrize("slant", [0.1, 0.4, 0.8])
def test_chords_of_a_slanted_patch_cost_what_its_slant_says(slant):
    """Seen from afar, on average over their directions: -log((1 + cos) / 2) = -log(cos) / 2 to second order."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(slant), -np.sin(slant)], [0.0, np.sin(slant), np.cos(slant)]])
    total = 0.0
    angles = np.linspace(0.0, np.pi, 400, endpoint=False)
    for angle in angles:
        half = 1e-4 * turn @ [np.cos(angle), np.sin(angle), 0.0]
        a, b = np.array([0.0, 0.0, 1.0]) - half, np.array([0.0, 0.0, 1.0]) + half
        u, v = b[:2] / b[2] - a[:2] / a[2]
        total += log_foreshortening_kernel(u, v, np.log(a[2]), np.log(b[2]), log_chord_kernel(*a, *b)[0])
    assert total / len(angles) == pytest.approx(-np.log((1 + np.cos(slant)) / 2), abs=1e-6)
    assert total / len(angles) == pytest.approx(-0.5 * np.log(np.cos(slant)), abs=0.15 * slant**4)


def test_it_is_linear_everywhere_and_has_no_hessian():
    rng = np.random.default_rng(0)
    x, step = rng.normal(size=(2, 3))
    factor, graph = _factor(5.0), gtsam.GaussianFactorGraph()
    graph.push_back(factor.linearize(_values(*x)))
    information, linear = graph.hessian()
    order = np.argsort(KEYS)
    assert np.abs(information).max() < 1e-14
    assert linear[np.argsort(order)] == pytest.approx([2.5, 2.5, -5.0])
    expected = factor.error(_values(*x)) + 5.0 * (step[2] - 0.5 * (step[0] + step[1]))
    assert factor.error(_values(*(x + step))) == pytest.approx(expected, abs=1e-12)


def test_it_moves_what_other_factors_leave_open():
    graph, values = gtsam.NonlinearFactorGraph(), _values(0.1, -0.3, 0.2)
    graph.add(_factor(2.0))
    for k, sigma in zip(KEYS, (10.0, 0.1, 0.1), strict=True):
        graph.add(gtsam.PriorFactorVector(k, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, sigma)))
    found = values.retract(graph.linearize(values).optimize())
    assert [found.atVector(k)[0] for k in KEYS] == pytest.approx([100.0, 0.01, -0.02], abs=1e-9)
