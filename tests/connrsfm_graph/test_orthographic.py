"""Orthographic cameras on scenes with exact truth: what the images decide is found, what they do not is agreed on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.cli.evaluate import evaluated
from connrsfm_graph.errors import InputError
from connrsfm_graph.initialise import initialise
from connrsfm_graph.methods import METHODS
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.orthographic import even_signs, log_units, refine_from_afar
from connrsfm_graph.problem import Problem, make_problem
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, default_config, reconstruct
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.synthetic import Scene, isometric_bending, spheres, with_missing, with_noise
from connrsfm_graph.tracks import Tracks, load_tracks, save_tracks
from factors.conformal_pair import residuals
from factors.noise import EXTRINSIC_ROWS
from factors.surface import ORTHOGRAPHIC, metric


@pytest.fixture(scope="module")
def bending() -> Scene:
    return isometric_bending(n_frames=6, n_points=80, camera=ORTHOGRAPHIC)


@pytest.fixture(scope="module")
def balls() -> Scene:
    return spheres(n_frames=6, n_points=80, camera=ORTHOGRAPHIC)


@pytest.fixture(scope="module")
def smooth() -> Tracks:
    return isometric_bending(n_frames=6, n_points=80, camera=ORTHOGRAPHIC, smooth=True, seed=1).tracks


@pytest.fixture(scope="module")
def result(smooth: Tracks) -> Reconstruction:
    return reconstruct(smooth)[0]


def all_edges(scene: Scene) -> np.ndarray:
    return np.stack(np.triu_indices(scene.tracks.n_frames, 1), axis=1)


def exact(scene: Scene) -> Problem:
    edges = all_edges(scene)
    weight = np.ones((len(edges), scene.tracks.n_points))
    return make_problem(scene.image, scene.tracks.visible, edges, scene.jets(edges), weight, ORTHOGRAPHIC)


def error_up_to_mirror_images(result: Reconstruction, tracks: Tracks) -> float:
    """Mean 3D error in percent, the better of each image's surface and its mirror image: isometry knows no more."""
    both = [
        evaluate(result.points, each.points, tracks.visible, image=result.points[..., :2])
        for each in (tracks, tracks.mirrored())
    ]
    assert both[0].coverage == 1.0
    per_frame = [[frame["e3d_percent"] for frame in evaluation.per_frame] for evaluation in both]
    return float(np.min(per_frame, axis=0).mean())


def rows(scene: Scene) -> np.ndarray:
    """The 21 rows of the pair factor at the truth, (E, P, 21)."""
    edges = all_edges(scene)
    a, b = edges.T
    y = np.concatenate([scene.first_order, scene.second_order], axis=-1)
    data = scene.jets(edges).pair_data(scene.image[a], scene.image[b])
    return residuals(data, y[a], y[b], np.log(scene.conformal_scale(edges)), ORTHOGRAPHIC)


def test_tracks_are_the_first_two_coordinates(bending: Scene) -> None:
    np.testing.assert_allclose(bending.tracks.normalised(), bending.tracks.points[..., :2], atol=1e-13)


def test_the_pair_factor_holds_as_under_perspective(bending: Scene, balls: Scene) -> None:
    """All rows for similarities; for isometries all but those of the second fundamental form."""
    assert np.abs(rows(balls)).max() < 1e-10
    bent = rows(bending)
    assert np.abs(np.delete(bent, EXTRINSIC_ROWS, axis=-1)).max() < 1e-10
    assert np.abs(bent).max() > 0.1


def test_a_mirrored_truth_belongs_to_the_same_images(bending: Scene) -> None:
    """Its normals are still those of its points, towards the camera."""
    mirrored = bending.tracks.mirrored()
    np.testing.assert_array_equal(mirrored.points[..., :2], bending.tracks.points[..., :2])
    assert (mirrored.normals[..., 2] < 0).all()
    np.testing.assert_array_equal(
        metric(bending.image, bending.first_order, camera=ORTHOGRAPHIC),
        metric(bending.image, -bending.first_order, camera=ORTHOGRAPHIC),
    )
    np.testing.assert_array_equal(mirrored.mirrored().normals, bending.tracks.normals)


def test_the_pre_step_is_exact_up_to_mirror_images(bending: Scene) -> None:
    state = initialise(exact(bending), BatchedBackend())
    found, truth = state.first_order, bending.first_order.transpose(1, 0, 2)
    sign = np.sign((found * truth).sum(axis=(0, 2)))
    np.testing.assert_allclose(found, sign[:, None] * truth, atol=1e-5)


def test_signs_follow_a_surface_through_its_level_lines(bending: Scene, balls: Scene) -> None:
    """A ridge or a top turns the slope's sign; the slopes change evenly nevertheless."""
    flip = np.random.default_rng(0).choice([-1.0, 1.0], bending.tracks.n_points)
    for scene in (bending, balls):
        for image, slopes in zip(scene.image, scene.first_order, strict=True):
            sign = even_signs(image, flip[:, None] * slopes) * flip
            steep = np.linalg.norm(slopes, axis=1) > 0.05
            assert abs(sign[steep].sum()) == steep.sum()


def test_units_of_the_images_show_in_the_images(balls: Scene) -> None:
    problem = exact(balls)
    jacobian = np.stack([np.broadcast_to(np.eye(2), problem.data[:, 0, 4:8].reshape(-1, 2, 2).shape)], axis=1)
    jacobian = np.concatenate([jacobian, problem.data[:, :5, 4:8].reshape(-1, 5, 2, 2)], axis=1)  # edges of image 0
    unit = log_units(jacobian, np.zeros(jacobian.shape[:2], dtype=int))
    size = balls.log_size.mean(axis=1)
    np.testing.assert_allclose(unit, size.mean() - size, atol=0.05)


def test_a_smooth_motion_is_reconstructed_up_to_one_mirror_image(result: Reconstruction, smooth: Tracks) -> None:
    evaluation, truth = evaluated(result, smooth, "truth")
    assert evaluation.e3d_percent < 0.05
    assert evaluation.normal_error_deg < 1.0
    assert result.camera is ORTHOGRAPHIC
    np.testing.assert_allclose(result.points[..., :2], smooth.normalised(), atol=1e-3)
    other = evaluated(result, smooth.mirrored(), "truth")
    assert other[0].e3d_percent == pytest.approx(evaluation.e3d_percent)
    np.testing.assert_array_equal(other[1], truth)


def test_isometry_decides_each_image_up_to_its_mirror_image(bending: Scene) -> None:
    """Independent bendings share no second fundamental form that could tell which images to mirror."""
    for tracks, bound in ((with_missing(bending.tracks, 0.3), 0.05), (with_noise(bending.tracks, 1.0), 0.2)):
        assert error_up_to_mirror_images(reconstruct(tracks)[0], tracks) < bound
    assert error_up_to_mirror_images(reconstruct(bending.tracks, default_config("paper"))[0], bending.tracks) < 1.0


def test_similar_spheres_in_units_of_their_own(balls: Scene) -> None:
    """Their radii differ by up to a factor of four: one scale per image is found."""
    result, record = reconstruct(balls.tracks)
    assert evaluated(result, balls.tracks, "truth")[0].e3d_percent < 1.0
    scale = balls.conformal_scale(result.edges)
    assert np.median(np.abs(result.conformal_scale / scale - 1.0)) < 0.1
    assert record.decisions["model"] == "isometric"


def test_the_unit_of_length_does_not_matter(result: Reconstruction, smooth: Tracks) -> None:
    K = smooth.K.copy()
    K[:, :2, :2] /= 1000.0
    large, _ = reconstruct(replace(smooth, K=K))
    for name, power in (("points", 1), ("depth", 1), ("normals", 0), ("first_order", 0), ("second_order", -1)):
        a, b = getattr(result, name) * 1000.0**power, getattr(large, name)
        np.testing.assert_allclose(a, b, atol=1e-3 * np.abs(b).max())


def test_the_refinement_from_afar_leaves_the_truth_alone(smooth: Tracks) -> None:
    image, depth = smooth.normalised(), smooth.points[..., 2]
    refined = refine_from_afar(image, smooth.visible, depth, RefineConfig(), 1e-5)
    np.testing.assert_allclose(refined.points[..., 2], depth - depth.mean(axis=1, keepdims=True), atol=5e-3)


def test_depths_refined_from_afar_are_about_as_sure_as_they_say(smooth: Tracks) -> None:
    """The distance of a view, of which the camera sees nothing, is no part of it."""
    image = smooth.normalised()
    depth = smooth.points[..., 2] - smooth.points[..., 2].mean(axis=1, keepdims=True)
    sigma = 2e-3
    squares = []
    for seed in range(4):
        noisy = image + np.random.default_rng(seed).normal(scale=sigma, size=image.shape)
        refined = refine_from_afar(noisy, smooth.visible, depth, RefineConfig(), sigma)
        squares.append((((refined.points[..., 2] - depth) / refined.depth_std) ** 2).mean())
    assert 0.3 < np.mean(squares) < 3.0
    assert np.isnan(
        refine_from_afar(noisy, smooth.visible, depth, RefineConfig(uncertainty=False), sigma).depth_std
    ).all()


def test_files_keep_the_camera(result: Reconstruction, smooth: Tracks, tmp_path: Path) -> None:
    save_tracks(tmp_path / "tracks.npz", smooth)
    assert load_tracks(tmp_path / "tracks.npz").camera is ORTHOGRAPHIC
    assert load_tracks(tmp_path / "tracks.npz", camera="perspective").camera.name == "perspective"
    result.save(tmp_path / "result.npz")
    assert Reconstruction.load(tmp_path / "result.npz").camera is ORTHOGRAPHIC


def test_no_slope_anywhere_is_no_start(bending: Scene) -> None:
    with pytest.raises(InputError, match="start is 'zeros', from which orthographic cameras lead nowhere"):
        initialise(exact(bending), BatchedBackend(), start="zeros")


def test_baselines_refuse_the_camera(smooth: Tracks) -> None:
    with pytest.raises(InputError, match="'infp' is for perspective cameras, the tracks are orthographic"):
        METHODS["infp"](smooth, Config(), Progress())


def test_an_unknown_camera_is_refused(smooth: Tracks) -> None:
    with pytest.raises(InputError, match="'camera' is 'fisheye', expected one of perspective, orthographic"):
        Tracks.checked(smooth.pixels, smooth.K, camera="fisheye")
