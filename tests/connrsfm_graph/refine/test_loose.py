"""Edges that keep no length, as those that cross a tear, or tell little of it: short ones that noise turns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.refine import task as task_module
from connrsfm_graph.refine.follow import follow
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.solve import minimise
from connrsfm_graph.refine.stage import refine
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.placing import facing_draws, flat_sheet, placed, rolled
from connrsfm_graph.synthetic.scene import Scene


def torn_sheet(seed: int) -> tuple[Scene, np.ndarray]:
    """A plane sheet cut from one border to its middle whose two flaps roll apart, and (P,) on which flap points are."""
    rng = np.random.default_rng(seed)
    s, t = flat_sheet(120, rng)
    beyond, left = s.value > 0.0, t.value > 0.0

    def draw() -> list[Jet]:
        surfaces = []
        for motion in rng.uniform(-1.0, 1.0, (8, 7)):
            opening = 0.6 * (1.0 + motion[0])
            up, down = (rolled((s * beyond, t), sign * opening, 0.0).data for sign in (1.0, -1.0))
            flaps = Jet(np.where(left, up, down))
            surfaces.append(placed(flaps + Jet.stack([s * ~beyond, 0.0 * s, 0.0 * s]), motion[1:], 25.0, (0.6, 1.0)))
        return surfaces

    return Scene.of(facing_draws(draw)), np.where(beyond, np.where(left, 1, -1), 0)


def error(scene: Scene, points: np.ndarray) -> float:
    assert scene.tracks.points is not None
    return evaluate(points, scene.tracks.points, scene.tracks.visible).e3d_percent


@pytest.mark.slow
def test_tears_are_found_and_let_their_sides_go(monkeypatch: pytest.MonkeyPatch) -> None:
    config, found, shared, errors = RefineConfig(uncertainty=False), [], [], []
    kept = Noise.after_fit
    for seed in range(4):
        scene, flap = torn_sheet(seed)
        tracks = scene.tracks
        given = tracks.normalised(), tracks.visible, np.zeros(tracks.visible.shape), config, 1e-4
        torn = refine(*given)
        i, k = torn.reference.fit.measurements.mesh.edges.T
        crosses, loose = flap[i] * flap[k] < 0, torn.reference.fit.noise.looseness > 3.0
        found.append(loose[crosses].mean())
        shared.append(loose[~crosses].mean())
        with monkeypatch.context() as patch:
            patch.setattr(Noise, "after_fit", lambda self, residual, seen: kept(self, residual, 0 * seen))
            whole = refine(*given)
        assert whole.reference.fit.noise.looseness.max() == 1.0
        every = np.arange(len(tracks.visible))
        followed = follow(torn.reference, *given[:2], every, config)
        errors.append([error(scene, each.points) for each in (torn, whole, followed)])
    assert np.median(found) > 0.5
    assert np.median(shared) < 0.1
    jointly, without, followed_later = np.exp(np.log(errors).mean(axis=0))
    assert jointly < 0.7 * without
    assert followed_later < 1.1 * jointly


def test_only_edges_far_looser_than_most_are_let_go() -> None:
    rng = np.random.default_rng(0)
    residual = rng.normal(0.0, 0.02, (10, 50))
    seen = rng.random((10, 50)) < 0.7
    seen[:, 7] = False
    residual[:, 7] = residual[~seen] = 9.0
    residual[:, 3] = rng.normal(0.0, 0.3, 10)
    noise = Noise.start(1e-3, 0.01, 0.1).after_fit(residual, seen)
    assert noise.looseness[3] > 10.0
    assert noise.looseness[7] == 1.0
    assert np.delete(noise.looseness, 3).max() < 1.5


def test_a_wrong_track_is_no_tear() -> None:
    residual, seen = np.random.default_rng(0).normal(0.0, 0.02, (8, 30)), np.ones((8, 30), dtype=bool)
    residual[2, 4] = residual[5, 9] = 3.0
    noise = Noise.start(1e-3, 0.01, 0.1)
    assert noise.after_fit(residual, seen).looseness.max() < 2.0
    residual[1, 9] = 3.0
    assert noise.after_fit(residual, seen).looseness[9] > 10.0


def test_rounds_go_on_while_edges_come_loose() -> None:
    start = Noise.start(1e-3, 0.01, 0.1)
    before = start.after_fit(np.full((4, 20), 0.01), np.ones((4, 20), dtype=bool))
    residual = np.full((4, 20), 0.01)
    residual[:, 0] = 0.5
    after = before.after_fit(residual, np.ones((4, 20), dtype=bool))
    assert not after.settled(before)
    residual[:, 0] = 0.8
    assert after.after_fit(residual, np.ones((4, 20), dtype=bool)).settled(after)


def test_in_exact_data_no_edge_is_loose_however_much_it_differs_from_others() -> None:
    residual = np.full((10, 50), 1e-7)
    residual[:, 3] = 1e-3
    assert Noise.start(1e-3, 0.01, 0.1).after_fit(residual, residual > 0.0).looseness.max() < 1.02


def near_twins(noise: float) -> tuple[Task, Noise]:
    """A noisy sheet on which two points are nearer to each other than a tenth of the spacing, and its noise."""
    scene = isometric_bending(6, 60, seed=3)
    points = scene.tracks.points.copy()
    other = int(np.linalg.norm(points[0] - points[0, 30], axis=-1).argsort()[1])
    points[:, 30] = 0.92 * points[:, other] + 0.08 * points[:, 30]
    image = points[..., :2] / points[..., 2:]
    image += np.random.default_rng(0).normal(0.0, noise, image.shape)
    seen = np.ones(image.shape[:2], dtype=bool)
    task = Task.of(complete(image, seen, np.log(points[..., 2])), seen, RefineConfig())
    return task, Noise.start(noise, 1e-4, task.spacing())


def test_short_edges_are_loosened_and_pulled_at_less() -> None:
    task, noise = near_twins(1e-4)
    measurements = task.measurements(replace(noise, patches=50, turns=True), conformal=False)
    looseness = 1.0 / (noise.length * measurements.length_weight)
    shorter = np.exp(task.mesh.usual(measurements.log_length) - measurements.log_length)
    np.testing.assert_allclose(looseness, np.tile(np.maximum(1.0, 0.5 * shorter) ** 2, (6, 1)))
    assert looseness.max() > 10.0
    assert np.median(looseness) == 1.0
    assert measurements.frontal.sum() == pytest.approx(8.0 * 50)
    np.testing.assert_allclose(measurements.frontal * looseness[0], measurements.frontal.max())


def test_a_short_edge_does_not_make_steps_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first steps under a tenth of the length noise leave less to do."""
    left = []
    for part in (task_module._SHORT, 0.0):
        monkeypatch.setattr(task_module, "_SHORT", part)
        task, noise = near_twins(1e-3)
        shape = start_shape(task.completed, task.mesh)
        for length in (1e-2, 1e-3):
            measurements = task.measurements(replace(noise, length=length, turns=True), conformal=False)
            shape, costs = minimise(measurements, shape, 50, 1e-5, closely=length < 1e-2)
        left.append(np.array(costs) / min(costs) - 1.0)
    assert (left[0][1:3] < 0.5 * left[1][1:3]).all()
