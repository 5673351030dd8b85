"""Gross errors of tracks are found in the images, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.refine.wrong_tracks import _judge, wrong_tracks
from connrsfm_graph.synthetic import isometric_bending, moebius, with_missing, with_noise, with_outliers


@pytest.mark.parametrize("fraction", [0.05, 0.1, 0.2])
def test_wrong_tracks_are_found(fraction):
    tracks, wrong = with_outliers(with_noise(isometric_bending().tracks, 0.5), fraction)
    found = wrong_tracks(tracks.normalised(), tracks.visible)
    assert (found & wrong).sum() / found.sum() > 0.95
    assert (found & wrong).sum() / wrong.sum() > 0.9


@pytest.mark.parametrize("pixels", [0.0, 0.5, 4.0])
@pytest.mark.parametrize("scene", [isometric_bending(), moebius()], ids=["bending", "moebius"])
def test_right_tracks_are_left_alone(scene, pixels):
    tracks = with_noise(scene.tracks, pixels)
    assert wrong_tracks(tracks.normalised(), tracks.visible).mean() < 0.002


def test_unseen_points_are_not_judged():
    tracks = with_missing(isometric_bending().tracks, 0.5)
    assert not wrong_tracks(tracks.normalised(), tracks.visible)[~tracks.visible].any()


def test_too_few_points_to_judge_by_judge_nothing():
    rng = np.random.default_rng(0)
    assert not wrong_tracks(rng.uniform(size=(4, 5, 2)), np.ones((4, 5), dtype=bool)).any()


@pytest.mark.parametrize("point", range(0, 60, 12))
def test_a_track_wrong_in_half_of_its_views_is_right_in_the_others(point):
    """It disagrees with most views in all of them; forgiving it there leaves its wrong half in the reconstruction."""
    tracks = isometric_bending(n_frames=6, n_points=60).tracks
    image, wrong = tracks.normalised(), np.zeros_like(tracks.visible)
    wrong[:3, point] = True
    image[wrong] += 0.1 * np.array([[1.0, 0.3], [-0.5, 0.8], [0.2, -1.0]])
    np.testing.assert_array_equal(wrong_tracks(image, tracks.visible), wrong)


def test_how_arrays_are_stored_is_no_matter():
    """Nothing is compiled once more for arrays stored by columns, and the result is the same."""
    tracks, _ = with_outliers(with_noise(isometric_bending().tracks, 0.5), 0.1)
    image, visible = tracks.normalised(), tracks.visible
    by_rows = wrong_tracks(image, visible, (image, visible))
    compiled = len(_judge.signatures)
    by_columns = np.asfortranarray(image), np.asfortranarray(visible)
    np.testing.assert_array_equal(wrong_tracks(*by_columns, by_columns), by_rows)
    assert len(_judge.signatures) == compiled
