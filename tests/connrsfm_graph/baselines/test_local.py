"""The local baselines: their equations against independent formulas, and exact cases."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval2d

from connrsfm_graph.baselines import diff, infp
from connrsfm_graph.baselines.star import Star, reconstruct_star
from connrsfm_graph.errors import ComputationError
from connrsfm_graph.progress import Progress
from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import Tracks
from factors.isometric_pair import IsometricPair
from factors.warp_jet import WarpJet


@pytest.fixture
def sheet():
    """Rigid views of a nearly flat sheet, for which infinitesimal planarity is exact."""
    return isometric_bending(n_frames=5, n_points=20, bend=1e-4, seed=3)


def exact_star(scene) -> tuple[Star, WarpJet]:
    edges = np.array([[0, b] for b in range(1, len(scene.surfaces))])
    jets = scene.jets(edges)
    image = scene.image
    J = jets.jacobian
    inverse = np.linalg.inv(J)
    t = np.stack([np.einsum("epij,epji->ep", inverse, jets.hessian[..., k : k + 2]) for k in (0, 1)], axis=-1) / 3
    return Star(image[0], image[1:], J, t, np.ones(J.shape[:2], dtype=bool)), jets


def test_the_cubics_are_the_metric_rows_of_the_isometric_factor(sheet) -> None:
    star, jets = exact_star(sheet)
    first, second = infp.metric_cubics(star)
    data = jets.pair_data(np.broadcast_to(star.image_a, star.image_b.shape), star.image_b)
    rng = np.random.default_rng(0)
    for e, p in [(0, 0), (1, 7), (3, 19)]:
        y_a = rng.normal(size=2)
        y_b = np.linalg.solve(star.J[e, p].T, y_a - star.t[e, p])
        rows = IsometricPair(data[e, p]).residual(y_a, y_b)
        np.testing.assert_allclose(rows[:2], 0.0, atol=1e-12)
        np.testing.assert_allclose([polyval2d(*y_a, cubic[e, p]) for cubic in (first, second)], rows[2:], rtol=1e-9)


def test_infinitesimal_planarity_is_exact_for_planes(sheet) -> None:
    star, _ = exact_star(sheet)
    np.testing.assert_allclose(infp.reference_slopes(star), sheet.first_order[0], atol=1e-3)


def test_the_diffeomorphic_polynomial_follows_its_three_conditions() -> None:
    rng = np.random.default_rng(2)
    q_a, q_b, K, y_a = rng.normal(size=2), rng.normal(size=2), rng.normal(size=(2, 2)), rng.normal(size=2)
    z = K.T @ y_a
    n_a, n_b = np.array([y_a[1], -y_a[0]]), np.array([z[1], -z[0]])
    across = np.linalg.det(K) * (y_a @ y_a) * (q_b @ n_b)
    y_b = z * ((q_a @ n_a) * (z @ z) + n_a @ K @ z) / across
    w_a, w_b = (q + y + q * (q @ y) for q, y in ((q_a, y_a), (q_b, y_b)))
    crossed = np.linalg.det(np.stack([K @ w_b, w_a])) * across
    r = np.linalg.norm(y_a)
    c0, c1, c2 = diff.pair_quadratics(q_a, q_b[None], K[None], y_a[None] / r)
    np.testing.assert_allclose((c0 + c1 * r + c2 * r**2) * r**3, crossed, rtol=1e-10)


def test_a_spinning_zooming_camera_satisfies_the_diffeomorphic_conditions() -> None:
    """Turning about the optical axis carries level lines, tangents and normals to each other: p vanishes."""
    angle, q_a, y_a = 0.7, np.array([0.3, -0.2]), np.array([0.4, 0.5])
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    r = np.linalg.norm(y_a)
    c0, c1, c2 = diff.pair_quadratics(q_a, (R @ q_a)[None], R.T[None], y_a[None] / r)
    np.testing.assert_allclose(c0 + c1 * r + c2 * r**2, 0.0, atol=1e-14)


def test_images_that_share_nothing_with_the_reference_are_named(sheet) -> None:
    tracks = sheet.tracks
    visible = tracks.visible.copy()
    visible[4] = False
    hidden = Tracks.checked(np.where(visible[..., None], tracks.pixels, np.nan), tracks.K, visible)
    reconstruction, record = reconstruct_star(hidden, "infp", infp.reference_slopes, Progress())
    assert not reconstruction.recovered[4].any()
    assert reconstruction.recovered[:4].all()
    assert record.warnings == ("infp cannot recover images 4: too few shared tracks",)


def test_no_usable_pair_is_an_error(sheet) -> None:
    tracks = sheet.tracks.select(points=range(5))
    with pytest.raises(ComputationError, match="infp recovers no image"):
        reconstruct_star(tracks, "infp", infp.reference_slopes, Progress())
