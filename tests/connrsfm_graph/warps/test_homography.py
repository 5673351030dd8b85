"""Homographies fitted to points, and their jets."""

from __future__ import annotations

import numpy as np

from connrsfm_graph.warps.homography import Homography, fit_homography

RNG = np.random.default_rng(3)
POINTS = RNG.uniform(-1.5, 1.5, (30, 2))
TRUTH = Homography(np.array([[0.9, 0.3], [-0.2, 1.2]]), np.array([0.1, -0.2]), np.array([0.2, 0.1]))


def test_exact_points_give_the_homography():
    fitted = fit_homography(POINTS, TRUTH.jet(POINTS).value, np.ones(30))
    np.testing.assert_allclose(fitted.linear, TRUTH.linear, atol=1e-10)
    np.testing.assert_allclose(fitted.offset, TRUTH.offset, atol=1e-10)
    np.testing.assert_allclose(fitted.projective, TRUTH.projective, atol=1e-10)


def test_fit_is_a_minimum_of_the_distance_in_the_second_image():
    target = TRUTH.jet(POINTS).value + 0.02 * RNG.normal(size=(30, 2))
    weight = RNG.uniform(0.2, 1.0, 30)
    fitted = fit_homography(POINTS, target, weight)

    def cost(h: Homography) -> float:
        return float((weight[:, None] * (h.jet(POINTS).value - target) ** 2).sum())

    for axis in np.eye(8):
        for size in (-1e-3, 1e-3):
            d = size * axis
            moved = Homography(fitted.linear + d[:4].reshape(2, 2), fitted.offset + d[4:6], fitted.projective + d[6:])
            assert cost(moved) > cost(fitted)


def test_jets_match_finite_differences():
    jet = TRUTH.jet(POINTS)
    for axis in range(2):
        step = 1e-5 * np.eye(2)[axis]
        ahead, behind = TRUTH.jet(POINTS + step), TRUTH.jet(POINTS - step)
        np.testing.assert_allclose(jet.jacobian[..., axis], (ahead.value - behind.value) / 2e-5, atol=1e-8)
        second = (ahead.jacobian - behind.jacobian) / 2e-5
        np.testing.assert_allclose(jet.hessian[..., axis : axis + 2], second, atol=1e-8)


def test_points_on_both_sides_of_the_vanishing_line_get_an_affinity():
    wild = Homography(np.eye(2), np.zeros(2), np.array([2.0, 0.0]))
    fitted = fit_homography(POINTS, wild.jet(POINTS).value, np.ones(30))
    np.testing.assert_array_equal(fitted.projective, 0.0)
