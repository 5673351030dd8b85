"""Views caught in a wrong surface find the way out: lengths held, from other surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.restarts import restart
from connrsfm_graph.refine.solve import fit_views, minimise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Task
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.scene import Scene


def arcs_from_afar(n_frames: int = 6, n_points: int = 80) -> Scene:
    """A sheet rolled to a cylinder, more or less from view to view, seen from twelve times its length."""
    rng = np.random.default_rng(0)
    s, t = Jet.variables(*(rng.uniform(-1.0, 1.0, (2, n_points))))
    surfaces = []
    for bend, tilt in zip(np.linspace(0.5, 1.0, n_frames), np.linspace(-0.3, 0.3, n_frames), strict=True):
        half = (s * (0.5 * bend)).sin()
        sheet = Jet.stack([(s * bend).sin() / bend, t, half * half * (2.0 / bend)])
        turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        surfaces.append(sheet.rotated(turn) + np.array([0.0, 0.0, 24.0])[:, None])
    return Scene.of(surfaces)


def test_a_part_taken_for_its_mirror_image_is_turned_back() -> None:
    scene = arcs_from_afar()
    seen = scene.tracks.visible
    task = Task.of(complete(scene.image, seen, scene.log_depth), seen, RefineConfig())
    measurements = task.measurements(Noise.start(1e-5, 0.01, task.spacing()), conformal=False)
    true, _ = minimise(measurements, start_shape(task.completed, task.mesh), 30, 1e-4)

    # One half of view 2 is reflected about the line through its middle.
    log_depth = true.log_depth.copy()
    x = scene.image[2, :, 0]
    middle = log_depth[2, np.abs(x).argmin()]
    log_depth[2, x > 0] = 2.0 * middle - log_depth[2, x > 0]
    caught = replace(true, log_depth=log_depth)
    caught, stuck = fit_views(measurements, caught, 50, 1e-4)
    _, right = fit_views(measurements, true, 50, 1e-4)
    assert stuck[2] > 5.0 * right[2], "the wrong surface is a minimum of its own"

    found, renewed = restart(measurements, caught)
    assert renewed[2]
    found, cost = fit_views(measurements, found, 50, 1e-4)
    assert cost[2] < 1.5 * right[2]
    error = found.log_depth[2] - scene.log_depth[2]
    assert np.ptp(error) < 0.2 * np.ptp(scene.log_depth[2])
