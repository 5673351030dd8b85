"""Wrong tracks that only a fit has shown."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, Refined, refine, stage
from connrsfm_graph.synthetic import isometric_bending, with_noise

SIGMA = 1.0
"""Pixels."""


@pytest.mark.parametrize(("count", "fits"), [(1, 1), (12, 2)])
def test_few_of_them_do_not_start_the_fit_anew(monkeypatch, count, fits):
    """And points of those that are found come out as if they had never been seen there."""
    scene = isometric_bending(n_frames=6, n_points=100, seed=2)
    tracks = with_noise(scene.tracks, SIGMA, 0)
    sigma = SIGMA / float(tracks.focal_length())
    image, visible = tracks.normalised(), tracks.visible
    rng = np.random.default_rng(0)
    wrong = np.zeros_like(visible)
    wrong.flat[rng.choice(wrong.size, count, replace=False)] = True
    spoiled = np.where(wrong[..., None], image + rng.choice([-8.0, 8.0], image.shape) * sigma, image)
    monkeypatch.setattr(stage, "wrong_tracks", lambda image, visible: np.zeros_like(visible))
    monkeypatch.setattr(stage, "fit", fitted := Mock(wraps=stage.fit))

    def refined(image: np.ndarray, visible: np.ndarray) -> Refined:
        return refine(image, visible, scene.log_depth, RefineConfig(uncertainty=False), sigma)

    found = refined(spoiled, visible)
    assert fitted.call_count == fits
    assert found.outlier[wrong].mean() > 0.8
    assert not found.outlier[~wrong].any()
    never = refined(image, visible & ~wrong)
    truth = scene.tracks.points
    errors = [evaluate(each.points, truth, visible).e3d_percent for each in (found, never)]
    assert errors[0] < 1.2 * errors[1]
    extent = float(np.ptp(never.points, axis=1).max())
    assert np.abs(found.points - never.points)[found.outlier].max() < 0.01 * extent
