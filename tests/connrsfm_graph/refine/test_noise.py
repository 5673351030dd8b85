"""Noise levels that a fit has shown, and when they are believed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from connrsfm_graph.refine import RefineConfig, settle
from connrsfm_graph.refine.fit import fit
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.task import Fit, Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending

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
