"""Marginals of all points in compiled code are those that GTSAM finds point by point."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.solvers.gtsam_backend import marginal_covariances
from connrsfm_graph.solvers.marginals import first_order_covariances
from factors.keys import key
from factors.noise import PairNoise
from tests.connrsfm_graph.solvers.test_backends import random_problem


@pytest.mark.parametrize("active", [("d",), ("d", "c"), ("d", "c", "s")])
@pytest.mark.parametrize("noise", [PairNoise(0.5, 1.0, 2.0), PairNoise(0.5, 1.0, 2.0, huber=0.8)])
def test_marginals_are_gtsams(active, noise):
    problem, state = random_problem()
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
