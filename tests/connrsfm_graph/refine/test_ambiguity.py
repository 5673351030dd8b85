"""Inversions about the camera centre: no residual sees them; what does is used in the declared order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.refine.ambiguity import consensus, resolve, shear_correlation
from connrsfm_graph.refine.cost import Weights
from connrsfm_graph.refine.measurements import Measurements, Shape, costs, lag
from connrsfm_graph.refine.restarts import inverted
from connrsfm_graph.refine.start import log_chords, start_mesh
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import Scene, isometric_bending, mixed, moebius


def true_shape(scene: Scene, rings: int = 1) -> tuple[Measurements, Shape]:
    """The truth as a conformal shape, and the measurements it fulfils; views in a scale of their own."""
    seen = scene.tracks.visible
    completed = complete(scene.image, seen, scene.log_depth)
    mesh = start_mesh(completed, seen, rings)
    factor = scene.log_size - scene.log_size.mean(axis=1, keepdims=True)
    log_depth = scene.log_depth - scene.log_size.mean(axis=1, keepdims=True)
    shape = Shape(log_depth, np.zeros((*seen.shape, 2)), factor, np.zeros(len(mesh.edges)), np.zeros((len(seen), 0)))
    a, b = mesh.edges.T
    residual = log_chords(shape.points(scene.image), mesh.edges) - 0.5 * (factor[:, a] + factor[:, b])
    shape = replace(shape, log_length=np.median(residual, axis=0))
    measurements = Measurements(
        image=scene.image,
        image_weight=np.ones(seen.shape),
        log_depth=log_depth,
        log_length=shape.log_length,
        log_length_weight=np.zeros(len(mesh.edges)),
        length_weight=np.full(residual.shape, 100.0),
        factor_weight=np.zeros(len(seen)),
        strain_weight=0.0,
        mesh=mesh,
        frontal=np.zeros(len(mesh.edges)),
        weights=Weights(huber=1e9, bending=0.0, smoothness=0.0, drift=0.0, unit=0.0),
    )
    return measurements, shape


def test_moebius_images_of_a_surface_are_conformal_chord_by_chord():
    measurements, shape = true_shape(moebius(n_frames=4, n_points=80))
    assert costs(measurements, shape, lag(measurements, shape)).max() < 1e-18


def test_inverting_views_changes_no_cost_and_no_ray():
    measurements, shape = true_shape(mixed(n_frames=4, n_points=80))
    other = inverted(shape, measurements.image, np.array([True, False, True, False]))
    assert np.abs(other.log_depth[0] - shape.log_depth[0]).max() > 0.01
    before, after = (costs(measurements, s, lag(measurements, s)) for s in (shape, other))
    assert after == pytest.approx(before, rel=1e-9, abs=1e-18)
    points = other.points(measurements.image)
    assert points[..., :2] / points[..., 2:] == pytest.approx(measurements.image, abs=1e-14)
    twice = inverted(other, measurements.image, np.array([True, False, True, False]))
    assert twice.log_depth == pytest.approx(shape.log_depth, abs=1e-12)
    assert twice.log_factor == pytest.approx(shape.log_factor, abs=1e-12)


def test_the_second_fundamental_forms_of_moebius_images_agree_but_for_inverted_views():
    measurements, shape = true_shape(moebius(n_frames=5, n_points=150))
    flip = np.array([False, True, False, True, False])
    sign = np.where(flip, -1.0, 1.0)
    points = inverted(shape, measurements.image, flip).points(measurements.image)
    correlation = shear_correlation(points, measurements.mesh)
    assert (correlation * np.outer(sign, sign)).min() > 0.5


def test_moebius_images_are_decided_up_to_one_common_inversion():
    measurements, shape = true_shape(moebius(n_frames=5, n_points=150))
    mixed_up = inverted(shape, measurements.image, np.array([False, True, False, True, False]))
    found, ambiguity = resolve(mixed_up, measurements.image, measurements.mesh, np.zeros(5, dtype=bool))
    assert found.log_depth == pytest.approx(shape.log_depth, abs=1e-9)
    assert ambiguity.group.tolist() == [1] * 5
    assert "second fundamental form" in ambiguity.assumption


def test_noise_leaves_the_consensus_of_the_views_as_it_is():
    """Single pairs of views hardly correlate under noise; all together tell which are inverted."""
    measurements, shape = true_shape(moebius(n_frames=7, n_points=150), rings=2)
    flip = np.array([False, True, False, True, False, False, False])
    points = inverted(shape, measurements.image, flip).points(measurements.image)
    points *= 1.0 + 0.001 * np.random.default_rng(0).standard_normal((*points.shape[:2], 1))
    correlation = shear_correlation(points, measurements.mesh)
    found = consensus(correlation)
    assert np.abs(correlation).min() < 0.5
    assert found.agreement > 0.95
    assert found.same_form
    assert (found.sign * found.sign[0] < 0).tolist() == flip.tolist()
    assert found.margin.min() > 0.1


def test_bends_about_several_axes_share_no_form():
    for seed in range(4):
        measurements, shape = true_shape(mixed(n_frames=6, n_points=100, seed=seed), rings=2)
        assert not consensus(shear_correlation(shape.points(measurements.image), measurements.mesh)).same_form


def test_a_view_unlike_the_others_has_no_margin():
    found = consensus(np.array([[1.0, 0.9, 0.02], [0.9, 1.0, 0.01], [0.02, 0.01, 1.0]]))
    assert found.sign[0] == found.sign[1]
    assert found.margin[2] < 0.1 < found.margin[0]
    assert not found.same_form


def test_isometric_views_are_found_and_turned_right():
    measurements, shape = true_shape(isometric_bending(n_frames=5, n_points=100))
    mixed_up = inverted(shape, measurements.image, np.array([False, True, False, False, True]))
    found, ambiguity = resolve(mixed_up, measurements.image, measurements.mesh, np.zeros(5, dtype=bool))
    assert found.log_depth == pytest.approx(shape.log_depth, abs=1e-9)
    assert ambiguity.isometric.all()
    assert not ambiguity.group.any()


def test_what_nothing_decides_is_reported():
    measurements, shape = true_shape(mixed(n_frames=6, n_points=150))
    _, ambiguity = resolve(shape, measurements.image, measurements.mesh, np.zeros(6, dtype=bool))
    assert ambiguity.isometric.tolist() == [True, False] * 3
    assert ambiguity.group.tolist() == [0, 1, 0, 2, 0, 3]
    assert "varies least" in ambiguity.assumption


def test_declared_views_are_turned_to_agree():
    measurements, shape = true_shape(mixed(n_frames=4, n_points=100))
    mixed_up = inverted(shape, measurements.image, np.array([True, False, False, False]))
    declared = np.array([True, False, True, False])
    found, ambiguity = resolve(mixed_up, measurements.image, measurements.mesh, declared)
    assert found.log_depth[declared] == pytest.approx(shape.log_depth[declared], abs=1e-9)
    assert not ambiguity.group[declared].any()
