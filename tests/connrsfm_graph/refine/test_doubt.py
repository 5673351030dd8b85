"""What is done where an isometric fit leaves a doubt: another start."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.metrics import evaluate
from connrsfm_graph.refine import RefineConfig, refine
from connrsfm_graph.synthetic import with_noise
from connrsfm_graph.synthetic.scene import INTRINSICS
from connrsfm_graph.tracks import Tracks

PIXELS = 0.5


def waving_cloth(n_frames: int = 12, n_points: int = 120, seed: int = 0) -> Tracks:
    """Waves that run through a sheet held on the left, seen by a camera at rest: it stretches by a few percent."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(-1.0, 1.0, (n_points, 2)) * [1.0, 0.75]).T
    time = np.arange(n_frames)[:, None]
    waves = sum(
        np.sin(k * (x * np.cos(a) + y * np.sin(a)) + phase - speed * time) / (1 + n)
        for n, (k, a, phase, speed) in enumerate(rng.uniform([2, -0.6, 0, 0.3], [5, 0.6, 6.28, 0.9], (3, 4)))
    )
    z = 3.0 + 0.12 * (0.25 + 0.375 * (x + 1.0)) * waves
    points = np.stack([np.broadcast_to(x, z.shape), np.broadcast_to(y, z.shape), z], axis=-1)
    pixels = 500.0 * 2.0 * points[..., :2] / z[..., None] + INTRINSICS[:2, 2]
    K = INTRINSICS * np.array([[2.0, 2.0, 1.0]] * 2 + [[1.0, 1.0, 1.0]])
    return with_noise(Tracks.checked(pixels, K, points=points), PIXELS, seed)


@pytest.mark.parametrize("seed", [0, 9])
def test_a_start_that_is_wrong_in_all_views_is_left(seed: int) -> None:
    """Relief of the wrong sign makes lengths that agree with each other, and single views find no way out."""
    tracks = waving_cloth(seed=seed)
    log_depth = np.log(tracks.points[..., 2])
    start = -3.0 * (log_depth - log_depth.mean(axis=1, keepdims=True))
    settings = RefineConfig(uncertainty=False)
    found = refine(tracks.normalised(), tracks.visible, start, settings, PIXELS / tracks.focal_length())
    assert found.model == "isometric"
    assert evaluate(found.points, tracks.points, tracks.visible).e3d_percent < 1.0  # 3.2 and 3.4 without another start
