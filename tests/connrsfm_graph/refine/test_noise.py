"""Noise levels that a fit has shown, and when they are believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, refine, settle
from connrsfm_graph.refine.fit import fit
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Fit, Task, minimised
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, with_noise

SIGMA = 0.01
"""Assumed of exact image points."""


@pytest.mark.parametrize("moved", [False, True])
def test_image_noise_is_lowered_only_while_the_lengths_stay(monkeypatch, moved):
    """What little noise is left would else crumple all views alike: in a fit that moved the lengths."""
    scene = isometric_bending(n_frames=6, n_points=60, seed=1)
    tracks = scene.tracks
    completed = complete(tracks.normalised(), tracks.visible, scene.log_depth)
    task = Task.of(completed, tracks.visible, RefineConfig(uncertainty=False))
    assumed, refitted = [], settle.refitted

    def moving(task: Task, found: Fit, noise: Noise) -> Fit:
        assumed.append(noise.image)
        again = refitted(task, found, noise)
        shift = 2.0 * noise.length if moved else 0.0
        return replace(again, shape=replace(again.shape, log_length=again.shape.log_length + shift))

    monkeypatch.setattr(settle, "refitted", moving)
    found = fit(task, SIGMA)
    assert not found.noisy
    assert min(assumed) < 0.5 * SIGMA
    assert found.noise.image == (SIGMA if moved else min(assumed))


@pytest.mark.parametrize(
    ("in_common", "predicted", "noisy"),
    [(0.0, 2.0, True), (0.1, 0.8, True), (0.1, 0.999, False), (0.1, 1.2, False), (0.3, 0.8, False)],
)
def test_points_left_out_decide_where_corrections_have_a_little_in_common(monkeypatch, in_common, predicted, noisy):
    """Noise stands only where they are predicted better by more than chance; `predicted`: squared errors then, over
    those under less noise."""
    scene = isometric_bending(n_frames=6, n_points=60, seed=1)
    tracks = with_noise(scene.tracks, 2.0, seed=1)
    sigma = 2.0 / tracks.focal_length()
    completed = complete(tracks.normalised(), tracks.visible, scene.log_depth)
    task = Task.of(completed, tracks.visible, RefineConfig(uncertainty=False))
    noise = Noise.start(sigma, task.config.length_sigma, task.spacing())
    measurements = task.measurements(noise, conformal=False)
    shape, history = minimised(task, measurements, start_shape(task.completed, task.mesh))
    errors = np.random.default_rng(0).chisquare(2, 500)
    by_chance = errors * np.random.default_rng(1).uniform(0.8, 1.2, 500)
    by_chance *= errors.mean() / by_chance.mean()

    def canned(fits: tuple[Fit, Fit], seen: np.ndarray) -> list[np.ndarray]:
        assert fits[0].noise.image <= fits[1].noise.image == sigma
        return [errors, predicted * by_chance]

    monkeypatch.setattr(settle, "errors_of", canned)
    monkeypatch.setattr(Fit, "corrections_in_common", lambda found, seen: (in_common, 0.01))
    found = settle.settled(task, Fit(measurements, shape, noise, history, history[-1]))
    assert found.noisy is noisy
    assert found.evidence["image noise"] == found.noise.image


def test_noise_that_hides_a_small_misfit_is_noise_still(monkeypatch):
    """Image points that are off by what varies slowly, such as a lens's distortion, by less than by noise."""
    scene = isometric_bending(n_frames=12, n_points=100, smooth=True, seed=1)
    noisy, phase = with_noise(scene.tracks, 1.0, seed=1), np.random.default_rng(1).uniform(0.0, 2 * np.pi, (12, 1, 2))
    off = 0.8 * np.sin(8.0 * scene.tracks.normalised()[..., ::-1] + phase)
    tracks = replace(noisy, pixels=noisy.pixels + off)
    flat, settings = np.zeros_like(scene.log_depth), RefineConfig(uncertainty=False)
    errors = []
    for in_common in (settle.IN_COMMON, 0.0):
        monkeypatch.setattr(settle, "IN_COMMON", in_common)
        found = refine(tracks.normalised(), tracks.visible, flat, settings, 2.0 / tracks.focal_length())
        errors.append(evaluate(found.points, tracks.points).e3d_percent)
    assert errors[0] < 0.7 * errors[1]
