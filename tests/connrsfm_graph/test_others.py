"""Long sequences: images that follow keyframes are as good as those reconstructed with them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from connrsfm_graph.keyframes import KeyframeConfig
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.others import reconstruct_others
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, make_guide, reconstruct, reconstruct_jointly
from connrsfm_graph.running.config import RunningConfig
from connrsfm_graph.synthetic import isometric_bending, moebius, with_missing, with_noise, with_outliers

FEW = Config(keyframes=KeyframeConfig(most=8))


@pytest.fixture(scope="module")
def long_tracks():
    return isometric_bending(n_frames=16, n_points=60, smooth=True).tracks


def test_exact_tracks_are_reconstructed_exactly(long_tracks):
    result, record = reconstruct(long_tracks, FEW)
    assert record.decisions["keyframes"] == {"jointly": 8, "following": 8}
    assert evaluate(result.points, long_tracks.points, long_tracks.visible).e3d_percent < 0.02
    assert len(result.edges) == record.decisions["edges"]["tree"] + record.decisions["edges"]["extra"] + 8
    assert (result.edges[:, 0] < result.edges[:, 1]).all()
    # Isometric images have the same lengths, and a conformal scale of 1.
    assert np.nanmedian(np.abs(np.log(result.conformal_scale))) < 0.02


@pytest.mark.parametrize(
    "spoiled",
    [lambda t: with_noise(t, 1.0), lambda t: with_missing(t, 0.3), lambda t: with_outliers(t, 0.05)[0]],
    ids=["noise", "missing", "outliers"],
)
def test_following_costs_little_accuracy(long_tracks, spoiled):
    tracks = spoiled(long_tracks)
    jointly, _ = reconstruct(tracks, Config(keyframes=KeyframeConfig(most=None)))
    following, _ = reconstruct(tracks, FEW)
    seen = tracks.visible
    reference = evaluate(jointly.points, long_tracks.points, seen).e3d_percent
    assert evaluate(following.points, long_tracks.points, seen).e3d_percent < 1.5 * reference + 0.1
    assert np.isfinite(following.points[seen]).all()
    assert np.isfinite(following.depth_std[seen]).all()


def test_the_result_does_not_depend_on_the_blocks(long_tracks):
    tracks = with_outliers(with_noise(long_tracks, 1.0), 0.05)[0]
    first, _ = reconstruct(tracks, FEW)
    second, _ = reconstruct(tracks, replace(FEW, running=RunningConfig(block=5)))
    for item in fields(first):
        np.testing.assert_array_equal(getattr(first, item.name), getattr(second, item.name), err_msg=item.name)


def test_conformal_views_follow_and_keep_their_alternative():
    scene = moebius(n_frames=8, n_points=80)
    config = replace(FEW, refine=replace(FEW.refine, model="conformal"))
    joint = reconstruct_jointly(scene.tracks, config, Progress())
    other = reconstruct_others(make_guide(scene.tracks, joint, config), scene.image[:2], scene.tracks.visible[:2])
    assert other.keyframe.tolist() == [0, 1]
    ratio = other.surfaces.points[..., 2] / joint.surfaces.points[:2, :, 2]
    assert np.abs(np.log(ratio)).max() < 0.01
    assert (other.surfaces.ambiguous == joint.surfaces.ambiguous[:2]).all()
    assert (other.surfaces.alternative is None) == (joint.surfaces.alternative is None)
