"""Gross errors of tracks are found in the images, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.refine.wrong_tracks import wrong_tracks
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
