"""Marginals of all points in compiled code are those that GTSAM finds point by point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.solvers.gtsam_backend import marginal_covariances
from connrsfm_graph.solvers.interface import Minimum
from connrsfm_graph.solvers.marginals import certainty, first_order_covariances
from factors.keys import key
from factors.noise import ROWS, PairNoise
from tests.connrsfm_graph.solvers.test_backends import random_problem


@pytest.mark.parametrize("active", [("d",), ("d", "c"), ("d", "c", "s")])
@pytest.mark.parametrize("noise", [PairNoise(0.5, 1.0, 2.0), PairNoise(0.5, 1.0, 2.0, huber=0.8)])
@pytest.mark.parametrize("precise", [False, True])
def test_marginals_are_gtsams(active, noise, precise):
    problem, state = random_problem()
    if precise:
        precision = np.random.default_rng(1).uniform(0.3, 3.0, size=(*problem.weight.shape, ROWS))
        problem = replace(problem, precision=precision)
    found = first_order_covariances(problem, state, active, noise)
    assert np.isnan(found[~problem.constrained()]).all()
    for point in range(problem.n_points):
        wanted = marginal_covariances(problem, state, point, active, noise)
        for view in np.flatnonzero(problem.constrained()[point]).tolist():
            expected = wanted[key("d", point, view)]
            np.testing.assert_allclose(found[point, view], expected, rtol=1e-8, atol=1e-10 * np.trace(expected))


def test_a_point_that_its_pairs_do_not_determine_takes_the_prior():
    problem, state = random_problem()
    undetermined = ("d", "c", "b", "s")
    assert np.isnan(first_order_covariances(problem, state, undetermined, PairNoise())).any()
    found = first_order_covariances(problem, state, undetermined, PairNoise(), prior=0.01)[problem.constrained()]
    variances = np.linalg.eigvalsh(found)
    assert (variances > 0).all()
    assert (variances <= 100.0 * (1 + 1e-9)).all()


def test_terms_are_the_surer_the_more_precise_their_rows_are_and_the_less_these_leave():
    problem, state = random_problem()
    known = problem.constrained()
    others = known.copy()
    others[1] = False

    def found(of_point, cost):
        precision = np.full((*problem.weight.shape, ROWS), 3.0)
        precision[1] *= of_point
        at = Minimum(state, np.array([1.0, cost, 1.0, 1.0, 1.0, 1.0]), np.zeros(6, dtype=int))
        return certainty(replace(problem, precision=precision), at, ("d", "c"), PairNoise())

    before = found(1.0, 1.0)
    assert np.median(before[known]) == pytest.approx(1.0)
    assert (before[~known] == 0).all()
    for worse in (found(0.1, 1.0), found(1.0, 100.0)):
        assert (worse[1, known[1]] < 0.5 * before[1, known[1]]).all()
        assert np.ptp(worse[others] / before[others]) < 0.1
