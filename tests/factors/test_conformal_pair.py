"""The 21 virtual measurements on exact scenes, their gauge, and the factor made of them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from connrsfm_graph.synthetic import isometric_bending, spheres
from factors.adapter import FactorError
from factors.conformal_pair import COLUMNS, conformal_pair_factor, residuals
from factors.conformal_scale import closed_form_log_rho, positive_roots
from factors.isometric_pair import isometric_pair_factor
from factors.keys import key
from factors.noise import EXTRINSIC_ROWS, INTRINSIC_ROWS, METRIC_ROWS, ROWS, PairNoise

EDGES = np.array([(a, b) for a in range(4) for b in range(a + 1, 4)])


def _exact(scene):
    """Pair data (E, P, 14), terms of both images (E, P, 5) and log rho (E, P) at the truth."""
    a, b = EDGES.T
    image = scene.image
    data = scene.jets(EDGES).pair_data(image[a], image[b])
    terms = np.concatenate([scene.first_order, scene.second_order], axis=-1)
    log_rho = np.log(scene.conformal_scale(EDGES)) + scene.log_depth[b] - scene.log_depth[a]
    return data, terms[a], terms[b], log_rho


def test_theorem_1_holds_on_spheres_and_needs_second_order_terms():
    data, ya, yb, log_rho = _exact(spheres(n_frames=4))
    assert np.abs(residuals(data, ya, yb, log_rho)).max() < 1e-10
    flat_a, flat_b = ya.copy(), yb.copy()
    flat_a[..., 2:] = flat_b[..., 2:] = 0
    assert np.abs(residuals(data, flat_a, flat_b, log_rho)).max() > 1e-1


def test_bending_keeps_metric_and_intrinsic_rows_only():
    rows = np.abs(residuals(*_exact(isometric_bending(n_frames=4))))
    assert rows[..., METRIC_ROWS].max() < 1e-10
    assert rows[..., INTRINSIC_ROWS].max() < 1e-10
    assert rows[..., EXTRINSIC_ROWS].max() > 1e-2


def test_blocks_partition_the_rows():
    assert sorted([*METRIC_ROWS, *INTRINSIC_ROWS, *EXTRINSIC_ROWS]) == list(range(ROWS))


def test_closed_form_scale_is_exact():
    scene = spheres(n_frames=4)
    data, *_, log_rho = _exact(scene)
    frame = np.concatenate([scene.first_order, scene.second_order, scene.log_depth[..., None]], axis=-1)
    point_major = np.ascontiguousarray(data.transpose(1, 0, 2)), np.ascontiguousarray(frame.transpose(1, 0, 2))
    for noise in (PairNoise(), PairNoise(intrinsic=np.inf, extrinsic=np.inf), PairNoise(metric=np.inf)):
        precision = np.tile(noise.precisions(), (*data.shape[1::-1], 1))
        found = closed_form_log_rho(point_major[0], np.ones(data.shape[1::-1]), point_major[1], EDGES, precision)
        assert found == pytest.approx(log_rho.T, abs=1e-9)


@pytest.mark.parametrize("degree", range(1, 7))
def test_positive_roots_are_all_where_the_sign_changes(degree):
    rng = np.random.default_rng(degree)
    for _ in range(200):
        p = rng.normal(size=degree + 1) * 10.0 ** rng.uniform(-3, 3, size=degree + 1)
        roots = np.roots(p[::-1])
        expected = np.sort(roots[(roots.real > 0) & (np.abs(roots.imag) < 1e-9 * np.abs(roots))].real)
        assert positive_roots(p) == pytest.approx(expected, rel=1e-6)


def _random_pair(rng):
    data = rng.normal(scale=0.3, size=14) + np.array([0] * 4 + [1, 0, 0, 1] + [0] * 6)
    return data, rng.normal(scale=0.4, size=COLUMNS)


def test_cost_depends_on_depths_and_scale_through_rho_only():
    data, state = _random_pair(np.random.default_rng(0))
    factor = conformal_pair_factor(0, 0, (0, 1), data, state, active=("b", "s"))
    values = gtsam.Values()
    for name, view, column in (("b", 0, 5), ("b", 1, 11), ("s", 0, 12)):
        values.insert(key(name, 0, view), state[column : column + 1])
    reference = factor.error(values)
    for shift_a, shift_b in ((1.0, 1.0), (0.3, -0.9)):
        moved = gtsam.Values(values)
        moved.update(key("b", 0, 0), state[5:6] + shift_a)
        moved.update(key("b", 0, 1), state[11:12] + shift_b)
        moved.update(key("s", 0, 0), state[12:13] + shift_a - shift_b)
        assert factor.error(moved) == pytest.approx(reference, rel=1e-10)


def test_jacobian_has_rank_eleven_at_exact_geometry():
    scene = spheres(n_frames=2)
    edge = np.array([[0, 1]])
    data = scene.jets(edge).pair_data(scene.image[:1], scene.image[1:])[0, 0]
    state = np.concatenate(
        [np.r_[scene.first_order[j, 0], scene.second_order[j, 0], scene.log_depth[j, 0]] for j in (0, 1)]
        + [np.log(scene.conformal_scale(edge)[0, :1])]
    )
    factor = conformal_pair_factor(0, 0, (0, 1), data, state)
    values = gtsam.Values()
    for view in (0, 1):
        for name, columns in (("d", slice(0, 2)), ("c", slice(2, 5)), ("b", slice(5, 6))):
            values.insert(key(name, 0, view), state[6 * view :][columns])
    values.insert(key("s", 0, 0), state[12:])
    jacobian = factor.linearize(values).jacobian()[0]
    assert jacobian.shape == (21, 13)
    assert np.linalg.matrix_rank(jacobian, tol=1e-8) == 11


def test_noise_model_is_what_it_says():
    noise = PairNoise(metric=0.5, intrinsic=2.0, extrinsic=np.inf, huber=0.7)
    model = noise.model(weight=4.0)
    r = np.arange(1.0, 22.0) * 0.004
    white = r * noise.precisions() * 2.0
    assert white[EXTRINSIC_ROWS] == pytest.approx(0)
    norm = np.linalg.norm(white)
    assert norm < 0.7
    assert model.loss(model.squaredMahalanobisDistance(r)) == pytest.approx(0.5 * norm**2)
    norm *= 10
    assert model.loss(model.squaredMahalanobisDistance(10 * r)) == pytest.approx(0.7 * (norm - 0.35))
    with pytest.raises(ValueError, match="intrinsic must be positive"):
        PairNoise(intrinsic=0.0)


def test_factor_refuses_bad_input():
    data, state = _random_pair(np.random.default_rng(1))
    bad = data.copy()
    bad[4] = np.nan
    with pytest.raises(FactorError, match="point 3, edge 5: data must be 14 finite numbers"):
        conformal_pair_factor(3, 5, (0, 1), bad, state)
    with pytest.raises(FactorError, match="state must be 13 finite numbers"):
        conformal_pair_factor(3, 5, (0, 1), data, state[:6])
    with pytest.raises(FactorError, match="active variables"):
        conformal_pair_factor(3, 5, (0, 1), data, state, active=("d", "z"))
    with pytest.raises(FactorError, match="dimension 4, expected 21"):
        conformal_pair_factor(3, 5, (0, 1), data, state, noise=gtsam.noiseModel.Unit.Create(4))


def test_pre_step_rows_vanish_for_planes_moved_rigidly():
    # A plane seen twice: n . X = 1 in the first camera, X' = R X + t; the warp is a homography, exact to all orders.
    rng = np.random.default_rng(2)
    n = np.array([0.1, -0.2, 0.25])
    angle = 0.3
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([0.2, 0.1, 0.5])
    H = R + np.outer(t, n)
    n2 = R @ n / (1 + n @ R.T @ t)

    def warp(x):
        X = H @ np.append(x, 1.0)
        return X[:2] / X[2]

    x = rng.uniform(-0.3, 0.3, size=2)
    h = 1e-4
    ex, ey = h * np.eye(2)
    jac = np.stack([(warp(x + e) - warp(x - e)) / (2 * h) for e in (ex, ey)], axis=-1)
    second = [
        (warp(x + ex) - 2 * warp(x) + warp(x - ex)) / h**2,
        (warp(x + ex + ey) - warp(x + ex - ey) - warp(x - ex + ey) + warp(x - ex - ey)) / (4 * h**2),
        (warp(x + ey) - 2 * warp(x) + warp(x - ey)) / h**2,
    ]
    data = np.concatenate([x, warp(x), jac.ravel(), np.stack(second, axis=-1).ravel()])
    # 1 / beta = n . (u, v, 1), so y = -(n1, n2) / (n . ray).
    first = [-m[:2] / (m @ np.append(p, 1.0)) for m, p in ((n, x), (n2, warp(x)))]
    factor = isometric_pair_factor(0, (0, 1), data)
    values = gtsam.Values()
    for view in (0, 1):
        values.insert(key("d", 0, view), first[view])
    assert factor.error(values) < 1e-9
    values.update(key("d", 0, 1), first[1] + 0.1)
    assert factor.error(values) > 1e-4
