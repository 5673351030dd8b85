from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic import spheres, with_missing, with_noise, with_outliers
from connrsfm_graph.tracks.tracks import Tracks


@pytest.fixture
def tracks() -> Tracks:
    return spheres(n_frames=10, n_points=200).tracks


def test_noise_has_the_asked_deviation_and_spares_the_truth(tracks: Tracks) -> None:
    noisy = with_noise(tracks, 3.0, seed=1)
    assert (noisy.pixels - tracks.pixels).std() == pytest.approx(3.0, rel=0.05)
    assert noisy.points is tracks.points
    np.testing.assert_array_equal(with_noise(tracks, 3.0, seed=1).pixels, noisy.pixels)


def test_the_asked_fraction_is_missing(tracks: Tracks) -> None:
    missing = with_missing(tracks, 0.3, seed=2)
    assert missing.visible.mean() == pytest.approx(0.7)
    np.testing.assert_array_equal(np.isnan(missing.pixels[..., 0]), ~missing.visible)
    twice = with_missing(missing, 0.5, seed=3)
    assert twice.visible.mean() == pytest.approx(0.35)
    assert not (twice.visible & ~missing.visible).any()


def test_outliers_are_gross_and_marked(tracks: Tracks) -> None:
    spoilt, wrong = with_outliers(with_missing(tracks, 0.2), 0.1, seed=4)
    assert wrong.sum() == round(0.1 * spoilt.visible.sum())
    assert not (wrong & ~spoilt.visible).any()
    moved = np.linalg.norm(spoilt.pixels - tracks.pixels, axis=-1)
    assert (moved[spoilt.visible & ~wrong] == 0).all()
    assert moved[wrong].min() > 0.09 * np.ptp(tracks.pixels, axis=1).max(axis=-1).min()


def test_an_impossible_fraction_is_refused(tracks: Tracks) -> None:
    with pytest.raises(InputError, match=r"between 0 and 1, got 1\.5"):
        with_missing(tracks, 1.5)
