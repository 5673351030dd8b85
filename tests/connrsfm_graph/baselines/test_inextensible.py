from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("clarabel", reason="the extra 'baselines' is not installed")

from connrsfm_graph.baselines.inextensible import InextensibleProgramme, nearest_neighbour_edges
from connrsfm_graph.baselines.mlh import non_rigidity, rigidity_gradient
from connrsfm_graph.synthetic import isometric_bending


@pytest.fixture
def scene():
    return isometric_bending(n_frames=4, n_points=40, seed=1)


def test_neighbours_are_near_in_every_image_that_sees_both() -> None:
    image = np.zeros((2, 4, 2))
    image[0, :, 0] = [0.0, 1.0, 2.0, 3.0]
    image[1, :, 0] = [0.0, 5.0, 2.0, 3.0]  # point 1 moves away from point 0
    visible = np.ones((2, 4), dtype=bool)
    assert nearest_neighbour_edges(image, visible, 1).tolist() == [[0, 2], [1, 3], [2, 3]]
    visible[1, 1] = False
    assert [0, 1] in nearest_neighbour_edges(image, visible, 1).tolist()


def test_points_never_seen_together_are_no_neighbours() -> None:
    visible = np.array([[True, True, False], [False, True, True]])
    edges = nearest_neighbour_edges(np.random.default_rng(0).normal(size=(2, 3, 2)), visible, 2)
    assert edges.tolist() == [[0, 1], [1, 2]]


def test_the_constraint_coordinates_are_the_distance_of_the_points(scene) -> None:
    programme = InextensibleProgramme.of(scene.image, scene.tracks.visible, 5)
    legs = np.random.default_rng(0).uniform(1.0, 2.0, programme.bound.shape)
    distance, _ = programme.distances(legs)
    points = legs[..., None] * programme.rays
    i, k = programme.edges[programme.edge].T
    expected = np.linalg.norm(points[programme.frame, i] - points[programme.frame, k], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(distance, axis=-1), expected, rtol=1e-12)


def test_the_optimum_is_feasible_and_beats_the_truth(scene) -> None:
    """The true surface, scaled to shared lengths of sum 1, is feasible; no feasible one has a larger objective."""
    programme = InextensibleProgramme.of(scene.image, scene.tracks.visible, 6)
    legs, lengths = programme.maximise(programme.rays[..., 2])
    distance = np.linalg.norm(programme.distances(legs)[0], axis=-1)
    assert (distance <= lengths[programme.edge] + 1e-7).all()
    assert lengths.sum() == pytest.approx(1.0)
    true_legs = np.linalg.norm(scene.tracks.points, axis=-1)
    longest = np.zeros(len(lengths))
    np.maximum.at(longest, programme.edge, np.linalg.norm(programme.distances(true_legs)[0], axis=-1))
    true_objective = (true_legs * programme.rays[..., 2]).sum() / longest.sum()
    assert (legs * programme.rays[..., 2]).sum() >= true_objective * (1 - 1e-7)


def test_legs_without_a_visible_neighbour_are_left_out(scene) -> None:
    visible = scene.tracks.visible.copy()
    visible[2, 1:] = False
    programme = InextensibleProgramme.of(scene.image, visible, 6)
    assert not programme.bound[2].any()
    legs, _ = programme.maximise(programme.bound.astype(float))
    assert (legs[2] == 0).all()
    assert np.isfinite(legs).all()


def test_the_rigidity_gradient_is_the_derivative(scene) -> None:
    programme = InextensibleProgramme.of(scene.image, scene.tracks.visible, 5)
    rng = np.random.default_rng(4)
    legs, step = rng.uniform(1.0, 2.0, programme.bound.shape), rng.normal(size=programme.bound.shape)
    h = 1e-6
    sums = [np.linalg.norm(programme.distances(legs + sign * h * step)[0], axis=-1).sum() for sign in (1, -1)]
    assert (rigidity_gradient(programme, legs) * step).sum() == pytest.approx((sums[0] - sums[1]) / (2 * h), rel=1e-6)


def test_a_convex_concave_step_lowers_the_non_rigidity(scene) -> None:
    programme = InextensibleProgramme.of(scene.image, scene.tracks.visible, 6)
    legs, lengths = programme.maximise(programme.bound.astype(float))
    before = non_rigidity(programme, legs, lengths)
    after = non_rigidity(programme, *programme.maximise(rigidity_gradient(programme, legs)))
    assert 0 <= after < before
