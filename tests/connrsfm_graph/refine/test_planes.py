"""Starts from planes that lean alike in all views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.reconstruct import Config, reconstruct
from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.refine.fit import fit_isometric
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.planes import from_planes
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Fit, Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, varied


def bent() -> tuple[Task, Noise]:
    """A task, and noise that is right for it."""
    scene = isometric_bending(n_frames=6, n_points=60, seed=1)
    tracks = scene.tracks
    completed = complete(tracks.normalised(), tracks.visible, scene.log_depth)
    task = Task.of(completed, tracks.visible, RefineConfig(uncertainty=False))
    return task, Noise.start(1.0 / tracks.focal_length(), task.config.length_sigma, task.spacing())


def test_the_cheapest_planes_are_gone_on_with():
    task, noise = bent()
    tried = []

    def fitted(plane: Task) -> Fit:
        """Costs what the plane's slope along x is away from 0.1."""
        image, depth = plane.completed.image, np.exp(plane.completed.log_depth)
        for view in range(len(image)):  # 1 / depth is linear in the image, alike in all views but for the middle
            rows = np.column_stack([image[view], np.ones(len(image[view]))])
            slope, *_ = np.linalg.lstsq(rows, 1.0 / depth[view], rcond=None)
            np.testing.assert_allclose(rows @ slope, 1.0 / depth[view], atol=1e-9)
            assert np.hypot(*slope[:2]) == pytest.approx(np.tan(np.radians(30.0)))
        tried.append((plane.config.iterations, np.arctan2(slope[1], slope[0])))
        shape = start_shape(plane.completed, plane.mesh)
        return Fit(plane.measurements(noise, conformal=False), shape, noise, [abs(slope[0] - 0.1)], 0.0)

    best = from_planes(task, fitted)
    assert len({round(np.degrees(angle)) % 360 for _, angle in tried}) == 6
    assert all(iterations < task.config.iterations for iterations, _ in tried)
    assert all(plane.config == task.config for plane, _ in best)
    costs = [found.history[-1] for _, found in best]
    assert len(costs) == 2
    assert costs == sorted(costs)
    assert costs[0] == pytest.approx(abs(np.tan(np.radians(30.0)) / 2.0 - 0.1))


def test_fits_that_are_beyond_doubt_start_from_no_plane(monkeypatch):
    def never(task: Task, fitted: object) -> list[tuple[Task, Fit]]:
        raise AssertionError("planes were tried")

    monkeypatch.setattr("connrsfm_graph.refine.fit.from_planes", never)
    task, noise = bent()
    fit_isometric(task, noise)
    shaken = task.completed.image + np.random.default_rng(0).normal(0.0, 5.0 * noise.image, task.completed.image.shape)
    with pytest.raises(AssertionError, match="planes were tried"):
        fit_isometric(replace(task, completed=replace(task.completed, image=shaken)), noise)


@pytest.mark.slow
def test_planes_lead_out_of_a_slant_that_is_wrong_in_all_views(monkeypatch):
    """Seven images before a camera at rest, of which the start makes 5 % of error."""
    tracks = varied("tissue", 87)
    settings = Config(refine=RefineConfig(uncertainty=False))
    ours, _ = reconstruct(tracks, settings)
    monkeypatch.setattr("connrsfm_graph.refine.fit.from_planes", lambda task, fitted: [])
    without, _ = reconstruct(tracks, settings)
    ours, without = (evaluate(each.points, tracks.points, tracks.visible).e3d_percent for each in (ours, without))
    assert ours < 0.8 * without
