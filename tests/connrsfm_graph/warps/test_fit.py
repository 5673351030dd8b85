"""Warps of an image graph: accuracy on exact scenes, noise, and what is reported of bad edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.scenes import isometric_bending, moebius, spheres
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.warps import WarpConfig, estimate_pixel_noise, fit_warps

MODELS = ["schwarzian", "bending", "gaussian_process"]
EDGES = np.array([[0, 1], [1, 2], [0, 2]])


def smooth_images(n: int = 120, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """(3, n, 2) a smoothly deforming sheet in normalised coordinates, off centre and small."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-1, 1, (2, n))
    images = []
    for t in (0.0, 0.6, 1.2):
        depth = 4 + 0.5 * np.sin(t + u) + 0.3 * t * v
        images.append(np.column_stack([(u + 0.2 * t * v * v) / depth, (v + 0.2 * t * u) / depth]))
    return np.stack(images) + np.array([0.3, -0.1]) + noise * rng.normal(size=(3, n, 2))


def all_visible(image: np.ndarray) -> np.ndarray:
    return np.ones(image.shape[:2], dtype=bool)


@pytest.mark.parametrize("scene", [isometric_bending(), moebius()], ids=["bending", "moebius"])
def test_gaussian_process_finds_the_jets_of_exact_scenes(scene):
    edges = np.array([[0, 1], [0, 2], [0, 3]])
    warps = fit_warps(scene.image, all_visible(scene.image), edges)
    truth = scene.jets(edges)
    assert warps.config.model == "gaussian_process"  # chosen: the points are those of a smooth map
    assert warps.valid.all()
    for name, bound in (("value", 1e-5), ("jacobian", 1e-3), ("hessian", 0.03)):
        found, true = getattr(warps.jets, name), getattr(truth, name)
        assert np.linalg.norm(found - true) < bound * np.linalg.norm(true), name


def test_gaussian_process_finds_the_jets_of_most_points_of_spheres():
    scene = spheres()
    edges = np.array([[0, b] for b in range(1, 7)])
    found, truth = fit_warps(scene.image, all_visible(scene.image), edges).jets, scene.jets(edges)
    error = np.linalg.norm(found.hessian - truth.hessian, axis=(2, 3)) / np.linalg.norm(truth.hessian, axis=(2, 3))
    assert np.median(error) < 0.04  # the few points near an outline have unbounded second derivatives


@pytest.mark.parametrize("model", MODELS)
def test_second_derivatives_match_finite_differences_of_the_warp(model):
    """Jets are given at the points only, so differences are taken between points that happen to lie close together."""
    image = smooth_images(200, 1e-4)
    warps = fit_warps(image, all_visible(image), EDGES, WarpConfig(model=model, robust=False))
    order = np.lexsort(image[0].T)
    a, b = order[:-1], order[1:]
    step = image[0, b] - image[0, a]
    near = np.linalg.norm(step, axis=1) < 0.03
    assert near.sum() > 10
    jets = warps.jets
    middle = (jets.jacobian[0, a] + jets.jacobian[0, b]) / 2
    change = jets.value[0, b] - jets.value[0, a]
    np.testing.assert_allclose(change[near], np.einsum("plk,pk->pl", middle, step)[near], atol=2e-5)
    second = (jets.hessian[0, a] + jets.hessian[0, b]) / 2
    hessian = second[..., [[0, 1], [1, 2]]]
    turn = jets.jacobian[0, b] - jets.jacobian[0, a]
    np.testing.assert_allclose(turn[near], np.einsum("plkm,pm->plk", hessian, step)[near], atol=3e-3)


@pytest.mark.parametrize("model", MODELS)
def test_warps_do_not_depend_on_units(model):
    image = smooth_images(80, 1e-3)
    config = WarpConfig(model=model)
    plain = fit_warps(image, all_visible(image), EDGES, config)
    scaled = fit_warps(40.0 * image + 7.0, all_visible(image), EDGES, config)
    np.testing.assert_allclose(scaled.jets.value, 40.0 * plain.jets.value + 7.0, rtol=1e-5)
    np.testing.assert_allclose(scaled.jets.jacobian, plain.jets.jacobian, atol=1e-5)
    np.testing.assert_allclose(scaled.jets.hessian * 40.0, plain.jets.hessian, atol=1e-3)
    np.testing.assert_allclose(scaled.noise, 40.0 * plain.noise, rtol=1e-4)
    assert plain.reports[0].residual == pytest.approx(plain.residual[0])


@pytest.mark.parametrize("noise", [5e-4, 2e-3, 8e-3])
def test_noise_estimate(noise):
    image = smooth_images(150, noise)
    assert estimate_pixel_noise(image, all_visible(image), EDGES) == pytest.approx(noise, rel=0.2)


def test_covariance_covers_the_errors_of_noisy_scenes():
    scene = isometric_bending()
    edges = np.array([[0, 1], [0, 2], [0, 3]])
    image = scene.image + 1e-3 * np.random.default_rng(0).normal(size=scene.image.shape)
    jets = fit_warps(image, all_visible(image), edges, WarpConfig(model="gaussian_process")).jets
    error = jets.derivatives() - scene.jets(edges).derivatives()
    normalised = np.einsum("epi,epij,epj->ep", error, np.linalg.inv(jets.covariance), error)
    assert 5.0 < normalised.mean() < 20.0  # 10 degrees of freedom


def test_points_not_shared_are_ignored():
    image = smooth_images()
    visible = all_visible(image)
    visible[1, ::3] = False
    hidden = np.where(visible[..., None], image, np.nan)
    warps = fit_warps(hidden, visible, EDGES)
    keep = visible[0] & visible[1]
    alone = fit_warps(image[:2][:, keep], np.ones((2, keep.sum()), dtype=bool), EDGES[:1], warps.config)
    np.testing.assert_array_equal(warps.valid[0], keep)
    np.testing.assert_array_equal(warps.jets.hessian[0, keep], alone.jets.hessian[0])
    assert np.isfinite(warps.jets.derivatives()).all()
    np.testing.assert_array_equal(warps.jets.jacobian[0, ~keep], np.broadcast_to(np.eye(2), ((~keep).sum(), 2, 2)))
    assert warps.reports[0].n_points == keep.sum()


@pytest.mark.parametrize("model", MODELS)
def test_mirrored_image_is_reported(model):
    image = smooth_images()
    image[2, :, 0] *= -1
    warps = fit_warps(image, all_visible(image), EDGES, WarpConfig(model=model))
    assert [report.usable for report in warps.reports] == [True, False, False]
    assert "mirrors" in warps.reports[1].problem
    assert not warps.valid[1:].any()
    assert warps.valid[0].all()


@pytest.mark.parametrize("few", [False, True])
def test_folded_points_are_left_out(monkeypatch, few):
    """And told where they are more than a few."""
    if few:
        monkeypatch.setattr("connrsfm_graph.warps.fit._BORDER", 0.2)
    image = smooth_images(200)
    # The right tenth of the sheet is folded over in image 2.
    edge = np.quantile(image[0, :, 0], 0.9)
    beyond = np.maximum(image[0, :, 0] - edge, 0.0)
    image[1] = image[0]
    image[1, :, 0] -= 2 * beyond + 5 * beyond**2
    warps = fit_warps(image, all_visible(image), EDGES[:1], WarpConfig(model="gaussian_process", shortest_scale=0.5))
    report = warps.reports[0]
    assert report.usable
    assert report.folded > 3
    assert (report.problem is None) is few
    assert few or "folded" in report.problem
    assert (~warps.valid[0]).sum() == report.folded
    assert beyond[~warps.valid[0]].min() > -1e-9
    np.testing.assert_array_equal(warps.valid[0], np.linalg.det(warps.jets.jacobian[0]) > 0)


def test_few_points_lines_and_random_pairs_are_reported():
    rng = np.random.default_rng(0)
    image = np.concatenate([smooth_images(60)[:1], smooth_images(60)[:1], rng.normal(size=(2, 60, 2))])
    image[2, :, 1] = 0.2 * image[2, :, 0]
    visible = all_visible(image)
    visible[1, 5:] = False
    warps = fit_warps(image, visible, np.array([[0, 1], [0, 2], [0, 3]]))
    assert warps.reports[0].problem == "only 5 shared points, a warp needs 6"
    assert warps.reports[1].problem == "the shared points lie on a line in the second image"
    assert not warps.reports[2].usable
    assert not warps.valid.any()
    assert np.isnan(warps.noise[:2]).all()
    assert np.isfinite(warps.jets.derivatives()).all()


def test_exactly_the_least_number_of_points_works():
    image = smooth_images(6)
    warps = fit_warps(image, all_visible(image), EDGES)
    assert warps.valid.all()
    assert np.abs(warps.jets.value[0] - image[1]).max() < 0.05


def test_duplicate_points_are_no_trouble():
    image = smooth_images(60)
    image[:, 7] = image[:, 3]
    for model in MODELS:
        warps = fit_warps(image, all_visible(image), EDGES, WarpConfig(model=model))
        assert warps.valid.all()
        np.testing.assert_allclose(warps.jets.hessian[:, 7], warps.jets.hessian[:, 3], atol=1e-6)


def test_same_input_gives_the_same_warps():
    image = smooth_images(100, 1e-3)
    first, second = (fit_warps(image, all_visible(image), EDGES) for _ in range(2))
    np.testing.assert_array_equal(first.jets.derivatives(), second.jets.derivatives())
    np.testing.assert_array_equal(first.jets.covariance, second.jets.covariance)


def test_weights_are_chosen_where_left_open():
    image = smooth_images(100, 2e-3)
    for model in ("schwarzian", "bending"):
        config = WarpConfig(model=model, schwarzian=None)
        chosen = getattr(fit_warps(image, all_visible(image), EDGES, config).config, model)
        noisier = image + 0.02 * np.random.default_rng(1).normal(size=image.shape)
        assert getattr(fit_warps(noisier, all_visible(image), EDGES, config).config, model) > chosen > 0


def test_rough_points_get_the_schwarzian_spline():
    rng = np.random.default_rng(0)
    image = smooth_images(250, 1e-3)
    # Wrinkles of all sizes: frequencies with heavy tails, as of a field that has few derivatives.
    frequency = 15.0 * rng.standard_t(2, size=(2, 300))
    angle = image[0] @ frequency + rng.uniform(0, 2 * np.pi, 300)
    image[1:] += 0.02 * np.sqrt(2 / 300) * np.stack([np.cos(angle) @ rng.normal(size=(300, 2)) for _ in range(2)])
    assert fit_warps(image, all_visible(image), EDGES).config.model == "schwarzian"


def test_progress_and_no_edges():
    image = smooth_images(40)
    calls = []
    fit_warps(image, all_visible(image), EDGES, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    empty = fit_warps(image, all_visible(image), np.empty((0, 2), dtype=int), WarpConfig(covariance=False))
    assert empty.jets.value.shape == (0, 40, 2)
    assert empty.jets.covariance is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edges": np.array([[0, 3]])}, "two different images among 0 to 2"),
        ({"edges": np.array([[1, 1]])}, "two different images"),
        ({"edges": np.array([0, 1])}, "shape \\(edges, 2\\)"),
        ({"visible": np.ones((3, 40))}, "expected bool"),
        ({"image": np.zeros((3, 40))}, "expected \\(frames, points, 2\\)"),
        ({"image": np.full((3, 40, 2), np.nan)}, "point 0 is visible in frame 0"),
    ],
)
def test_bad_input_is_named(change, message):
    image = smooth_images(40)
    arguments = {"image": image, "visible": all_visible(image), "edges": EDGES} | change
    with pytest.raises(InputError, match=message):
        fit_warps(**arguments)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"model": "affine"}, "expected one of auto"),
        ({"control_points": 3}, "expected 5 to 40"),
        ({"min_points": 2}, "at least 6"),
        ({"schwarzian": 0.0}, "expected a positive number"),
        ({"padding": -1.0}, "zero or more"),
        ({"probe_edges": 0}, "at least 1"),
    ],
)
def test_bad_settings_are_named(setting, message):
    with pytest.raises(InputError, match=message):
        replace(WarpConfig(), **setting)


@pytest.mark.realdata
@pytest.mark.parametrize(("added", "expected"), [(1.0, 1.0), (4.0, 4.0)])
def test_noise_added_to_exact_projections_is_found(realdata, added, expected):
    data = np.load(realdata("flag.npz"))
    pixels = data["tracks"] + added * np.random.default_rng(0).normal(size=data["tracks"].shape)
    tracks = Tracks.checked(pixels, data["K"], data["visible"])
    edges = np.array([[0, f] for f in range(1, tracks.n_frames)])
    sigma = estimate_pixel_noise(tracks.normalised(), tracks.visible, edges) * tracks.focal_length()
    assert sigma == pytest.approx(expected, rel=0.2)


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["tshirt", "kinect_paper"])
def test_wrong_tracks_of_real_data_are_found(realdata, name):
    data = np.load(realdata(f"{name}.npz"))
    tracks = Tracks.checked(data["tracks"], data["K"], data["visible"])
    image = tracks.normalised()
    edges = np.array([[0, f] for f in range(1, tracks.n_frames, 3)])
    rng = np.random.default_rng(0)
    wrong = rng.uniform(size=image.shape[:2]) < 0.1
    wrong[0] = False
    image[wrong] = rng.uniform(image.min(axis=(0, 1)), image.max(axis=(0, 1)), (wrong.sum(), 2))
    warps = fit_warps(image, tracks.visible, edges, WarpConfig(covariance=False))
    flagged, truth = warps.weight < 0.3, wrong[edges[:, 1]]
    assert (flagged & truth).sum() > 0.95 * truth.sum()
    assert (flagged & truth).sum() > 0.95 * flagged.sum()
