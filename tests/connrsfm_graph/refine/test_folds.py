"""Sharp folds: what single views make of them is often wrong, what other views have found is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, refine
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.restarts import restart
from connrsfm_graph.refine.solve import fit_views, minimise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Task
from connrsfm_graph.refine.unseen import complete

SIGMA = 0.001
"""Noise of the image points, normalised coordinates."""


def folded(n_frames: int, n_points: int, seed: int) -> np.ndarray:
    """(F, P, 3) a sheet of size 2 x 2, folded about one line by up to 75 degrees to either side."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-1.0, 1.0, (2, n_points))
    line = rng.uniform(-0.5, 0.5)
    along = np.linspace(-1.2, 1.2, 2001)  # the profile is an integral of its slope
    views = []
    for phase in np.arange(n_frames) * (2.0 * np.pi / n_frames) + rng.uniform(0.0, 1.0, n_frames):
        slope = 1.3 * np.sin(phase) * np.tanh((along - line) / 0.12)
        x, z = (
            np.interp(u, along, np.cumsum(part) * np.ptp(along) / len(along)) for part in (np.cos(slope), np.sin(slope))
        )
        turn = Rotation.from_euler("xyz", rng.uniform(-20.0, 20.0, 3), degrees=True).as_matrix()
        sheet = np.stack([x - x.mean(), v, z - z.mean()], axis=-1)
        views.append(sheet @ turn.T + [0.0, 0.0, 4.0])
    return np.array(views)


def noisy_image(points: np.ndarray, seed: int) -> np.ndarray:
    image = points[..., :2] / points[..., 2:]
    return image + np.random.default_rng(seed).normal(0.0, SIGMA, image.shape)


def test_a_view_starts_from_what_others_have_found() -> None:
    points = folded(8, 80, seed=1)
    seen = np.ones(points.shape[:2], dtype=bool)
    task = Task.of(complete(noisy_image(points, 1), seen, np.log(points[..., 2])), seen, RefineConfig())
    measurements = task.measurements(Noise.start(SIGMA, 0.01, task.spacing()), conformal=False)
    shape, _ = minimise(measurements, start_shape(task.completed, task.mesh), 30, 1e-4)
    one = np.array([0])
    view, true = measurements.views(one), shape.views(one)
    true, right = fit_views(view, true, 50, 1e-4)
    crumpled = true.log_depth + np.random.default_rng(0).normal(0.0, 0.3, true.log_depth.shape)
    caught, stuck = fit_views(view, replace(true, log_depth=crumpled), 50, 1e-4)
    assert stuck[0] > 3.0 * right[0], "the crumpled surface is a minimum of its own"

    turn = Rotation.from_euler("xyz", (8, -6, 10), degrees=True).as_matrix()  # the right surface, elsewhere
    middle = points[0].mean(axis=0)
    found, renewed = restart(view, caught, ((points[0] - middle) @ turn.T + 1.1 * middle)[None])
    assert renewed[0]
    _, cost = fit_views(view, found, 50, 1e-4)
    assert cost[0] == pytest.approx(right[0], rel=0.05)
    alone, _ = restart(view, caught)
    _, cost_alone = fit_views(view, alone, 50, 1e-4)
    assert cost_alone[0] > 1.5 * cost[0]


@pytest.mark.slow
def test_a_folded_sheet_is_isometric() -> None:
    """And to less than 1 %, which views restarted from simple surfaces only do not reach."""
    points = folded(12, 120, seed=0)
    seen = np.ones(points.shape[:2], dtype=bool)
    found = refine(noisy_image(points, 0), seen, np.zeros(seen.shape), RefineConfig(uncertainty=False), SIGMA)
    assert found.model == "isometric"
    assert evaluate(found.points, points).e3d_percent < 1.0
