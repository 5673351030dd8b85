"""Variances of the 21 rows that follow from the covariance of the warp's jet."""

from __future__ import annotations

import numpy as np
import pytest

from factors.conformal_pair import pair_workspace, residuals
from factors.jet_noise import jet_derivatives, row_variances
from factors.noise import EXTRINSIC_ROWS, INTRINSIC_ROWS, METRIC_ROWS, ROWS
from factors.surface import CAMERAS, PERSPECTIVE
from factors.warp_jet import JET_SIZE


def _pairs(rng, n):
    data = rng.normal(scale=0.3, size=(n, 14)) + np.array([0] * 4 + [1, 0, 0, 1] + [0] * 6)
    root = rng.normal(size=(n, JET_SIZE, JET_SIZE))
    return (data, *rng.normal(scale=0.4, size=(2, n, 5)), rng.normal(scale=0.2, size=n)), root @ root.swapaxes(1, 2)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_derivatives_are_those_of_a_small_step(camera):
    (data, ya, yb, log_rho), _ = _pairs(np.random.default_rng(0), 1)
    scratch = pair_workspace.py_func(), np.empty(14), np.empty(ROWS), np.empty(ROWS), np.empty((ROWS, 13))
    D = np.empty((ROWS, JET_SIZE))
    jet_derivatives(data[0], ya[0], yb[0], log_rho[0], camera.kappa, scratch, D)
    for k in range(JET_SIZE):
        step = np.zeros(14)
        step[4 + k] = 1e-6
        pair = ya[0], yb[0], log_rho[0], camera
        numeric = (residuals(data[0] + step, *pair) - residuals(data[0] - step, *pair)) / 2e-6
        assert D[:, k] == pytest.approx(numeric, abs=1e-8)
    assert np.abs(D).max() > 0.5


def test_variances_are_those_of_drawn_jets():
    rng = np.random.default_rng(1)
    (data, ya, yb, log_rho), covariance = _pairs(rng, 4)
    variance = row_variances(data, ya, yb, log_rho, 1e-6 * covariance)
    drawn = np.stack([rng.multivariate_normal(np.zeros(JET_SIZE), 1e-6 * each, 20000) for each in covariance])
    jets = np.repeat(data[:, None], 20000, axis=1)
    jets[..., 4:] += drawn
    rows = residuals(jets, ya[:, None], yb[:, None], log_rho[:, None])
    assert variance == pytest.approx(rows.var(axis=1), rel=0.05)


def test_second_derivatives_reach_the_intrinsic_rows_alone():
    pairs, covariance = _pairs(np.random.default_rng(2), 3)
    covariance[:, :4] = covariance[:, :, :4] = 0.0
    variance = row_variances(*pairs, covariance, PERSPECTIVE)
    assert (variance[:, INTRINSIC_ROWS] > 0).all()
    assert variance[:, [*METRIC_ROWS, *EXTRINSIC_ROWS]] == pytest.approx(0, abs=1e-20)
