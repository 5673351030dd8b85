"""What the refinement promises: better than its start, wrong tracks found, unseen points placed, the model chosen."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.reconstruct import reconstruct
from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.synthetic import Scene, isometric_bending, moebius, spheres, with_missing, with_noise, with_outliers
from connrsfm_graph.tracks import Tracks
from factors.surface import PERSPECTIVE


def bent() -> Scene:
    return isometric_bending(n_frames=6, n_points=70)


def rough_start(scene: Scene, sigma: float = 0.03, seed: int = 0) -> np.ndarray:
    """True log depths, smoothly wrong and every view in a scale of its own."""
    rng = np.random.default_rng(seed)
    slope, scale = rng.normal(scale=sigma, size=(2, len(scene.log_depth), 2)), rng.normal(size=len(scene.log_depth))
    tilt = np.einsum("fpi,fi->fp", scene.image, slope[0]) + np.einsum("fpi,fi->fp", scene.image**2, 10 * slope[1])
    return scene.log_depth + tilt + scale[:, None]


def error(points: np.ndarray, tracks: Tracks) -> float:
    return evaluate(points, tracks.points, tracks.visible).e3d_percent


def refined(tracks: Tracks, start: np.ndarray, sigma: float = 1e-5, **settings: object) -> Refined:
    return refine(tracks.normalised(), tracks.visible, start, RefineConfig(**settings), sigma)  # type: ignore[arg-type]


@pytest.mark.parametrize("scene", [bent(), spheres(n_frames=5, n_points=70)], ids=["bending", "spheres"])
def test_exact_tracks_lead_to_the_exact_surfaces(scene: Scene) -> None:
    start = rough_start(scene)
    found = refined(scene.tracks, start)
    before = error(PERSPECTIVE.points(scene.image, np.exp(start)), scene.tracks)
    assert before > 0.5
    assert error(found.points, scene.tracks) < 0.05
    assert found.model == "isometric"
    assert found.cost_history[-1] < found.cost_history[0]


@pytest.mark.parametrize("pixels", [1.0, 4.0])
def test_noisy_tracks_are_better_than_their_start(pixels: float) -> None:
    scene = bent()
    tracks = with_noise(scene.tracks, pixels)
    start = rough_start(scene)
    found = refined(tracks, start, sigma=pixels / tracks.focal_length())
    before = error(PERSPECTIVE.points(tracks.normalised(), np.exp(start)), tracks)
    assert error(found.points, tracks) < before
    rms = np.sqrt(np.nanmean(found.ray_correction**2)) * tracks.focal_length()
    assert 0.3 * pixels < rms < 1.5 * pixels


def test_the_truth_is_a_minimum() -> None:
    scene = bent()
    found = refined(scene.tracks, scene.log_depth)
    assert error(found.points, scene.tracks) < 0.02


def test_unseen_points_are_placed() -> None:
    scene = bent()
    tracks = with_missing(scene.tracks, 0.4)
    start = np.where(tracks.visible, rough_start(scene), np.nan)
    found = refined(tracks, start)
    placed = evaluate(found.points, scene.tracks.points, ~tracks.visible & (tracks.visible.sum(axis=0) >= 2))
    assert placed.coverage == 1.0
    assert placed.e3d_percent < 2.0


def test_wrong_tracks_are_flagged_and_their_points_recovered() -> None:
    scene = isometric_bending(n_frames=8, n_points=100)
    tracks, wrong = with_outliers(scene.tracks, 0.1)
    result, _ = reconstruct(tracks)
    assert (result.outlier & wrong).sum() >= 0.9 * wrong.sum()
    assert (result.outlier & wrong).sum() >= 0.9 * result.outlier.sum()
    recovered = evaluate(result.points, scene.tracks.points)
    assert recovered.coverage == 1.0
    assert recovered.e3d_percent < 0.5


def test_points_at_the_same_place_and_few_of_them() -> None:
    scene = isometric_bending(n_frames=4, n_points=12)
    pixels = scene.tracks.pixels.copy()
    pixels[:, 1] = pixels[:, 0]
    tracks = Tracks.checked(pixels, scene.tracks.K)
    found = refined(tracks, rough_start(scene))
    assert np.isfinite(found.points).all()
    assert np.linalg.norm(found.points[:, 0] - found.points[:, 1], axis=-1).max() < 0.05 * np.ptp(found.points[..., 0])


@pytest.mark.slow
def test_moebius_images_are_found_conformal() -> None:
    scene = moebius(n_frames=5, n_points=80)
    result, record = reconstruct(scene.tracks)
    assert record.decisions["model"] == "conformal"
    candidates = [result.points] if result.alternative is None else [result.points, result.alternative]
    best = min(range(len(candidates)), key=lambda k: error(candidates[k], scene.tracks))
    assert error(candidates[best], scene.tracks) < 0.5
    if best == 0:
        differences = [
            np.corrcoef(array[0] - array[j], truth[0] - truth[j])[0, 1]
            for array, truth in [(result.log_factor, scene.log_size)]
            for j in range(1, 5)
        ]
        assert np.median(differences) > 0.95
        found, truth = np.log(result.conformal_scale), np.log(scene.conformal_scale(result.edges))
        centred = [values - values.mean(axis=1, keepdims=True) for values in (found, truth)]
        assert np.corrcoef(centred[0].ravel(), centred[1].ravel())[0, 1] > 0.995


def test_bad_input_is_named() -> None:
    scene = bent()
    image, visible, depth = scene.image, scene.tracks.visible, scene.log_depth
    with pytest.raises(InputError, match="do not fit"):
        refine(image[:, :-1], visible, depth, RefineConfig(), 1e-3)
    broken = image.copy()
    broken[1, 2] = np.nan
    with pytest.raises(InputError, match="NaN where 'visible' is true"):
        refine(broken, visible, depth, RefineConfig(), 1e-3)
    hidden = visible.copy()
    hidden[3] = False
    with pytest.raises(InputError, match="image 3 sees no point"):
        refine(image, hidden, depth, RefineConfig(), 1e-3)
    with pytest.raises(InputError, match=r"refine\.rings is 5"):
        RefineConfig(rings=5)


@pytest.mark.parametrize("model", ["isometric", "conformal"])
def test_tracks_may_meet_in_an_image(model):
    """Neighbours on the same pixel of one image, one track given twice: surfaces of the others are as without."""
    scene = isometric_bending(n_frames=6, n_points=60, seed=4)
    image, log_depth = scene.image.copy(), scene.log_depth.copy()
    near = np.linalg.norm(image[0] - image[0, :1], axis=1).argsort()
    image[2, near[1]], log_depth[2, near[1]] = image[2, 0], log_depth[2, 0]
    image[:, near[2]], log_depth[:, near[2]] = image[:, 0], log_depth[:, 0]
    visible = np.ones(image.shape[:2], dtype=bool)
    refined = refine(image, visible, log_depth, RefineConfig(model=model, outliers=False), 1e-4)
    assert np.isfinite(refined.points).all()
    others = np.setdiff1d(np.arange(60), near[:3])
    error = refined.log_depth - scene.log_depth
    assert np.median(np.abs(error - np.median(error, axis=1, keepdims=True))[:, others]) < 0.01
