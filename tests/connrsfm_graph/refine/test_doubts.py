"""What those who use a fit are told of it."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.synthetic import isometric_bending

SIGMA = 0.001
"""Noise of the image points, normalised coordinates."""


def refined(points: np.ndarray, model: str = "auto") -> Refined:
    """From flat views, with noise."""
    image = points[..., :2] / points[..., 2:]
    image = image + np.random.default_rng(0).normal(0.0, SIGMA, image.shape)
    settings = RefineConfig(uncertainty=False, model=model)
    return refine(image, np.ones(points.shape[:2], dtype=bool), np.zeros_like(points[..., 2]), settings, SIGMA)


def sheet(**settings: float | bool) -> np.ndarray:
    """(F, P, 3) a sheet that bends."""
    points = isometric_bending(n_frames=8, n_points=80, seed=1, **settings).tracks.points
    assert points is not None
    return points


@pytest.mark.parametrize("pulled", [False, True])
def test_surfaces_that_do_not_keep_their_lengths_are_told(pulled: bool) -> None:
    """Pulled here and there, each image elsewhere."""
    points = sheet()
    if pulled:
        extent = np.ptp(points, axis=1).max()
        centre = points[np.arange(8), np.random.default_rng(1).integers(80, size=8)][:, None]
        near = np.exp(-0.5 * (((points - centre) / (0.2 * extent)) ** 2).sum(axis=-1, keepdims=True))
        points = points + 0.06 * extent * near * np.random.default_rng(2).normal(size=(8, 1, 3))
    found = refined(points, "isometric")
    assert any("does not keep its lengths" in warning for warning in found.warnings) is pulled


@pytest.mark.parametrize("at_rest", [False, True])
def test_slants_of_which_tracks_tell_little_are_told(at_rest: bool) -> None:
    found = refined(sheet(bend=0.2, at_rest=True) if at_rest else sheet())
    assert any("little about slants" in warning for warning in found.warnings) is at_rest
