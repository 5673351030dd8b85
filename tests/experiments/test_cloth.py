"""The cloth against its depth camera, and the plane it is compared with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from experiments.cloth import compare, image_errors
from experiments.loaders.cloth_r1 import load_cloth


def test_errors_are_percent_of_the_extent_and_planes_fit_planes() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (400, 2)), np.full(400, 5.0)])
    assert image_errors(3 * flat + 1, flat)[0].max() < 1e-9
    assert image_errors(flat, flat)[1].max() < 1e-9
    bent = flat + [0, 0, 1] * (0.2 * flat[:, :1] ** 2)
    error, plane = image_errors(flat, bent)
    assert np.median(error) == pytest.approx(100 * 0.06 / 2, rel=0.3)
    assert 0 < np.median(plane) <= np.median(error) * 1.2
    bent[7] = np.nan
    assert len(image_errors(flat, bent)[0]) == 399


@pytest.mark.realdata
@pytest.mark.slow
def test_hanging_cloth_is_far_better_than_a_plane(realdata: Callable[[str], Path]) -> None:
    tracks = load_cloth(realdata("cloth_r1"))
    assert tracks.n_frames == 10
    assert tracks.visible.sum(axis=1).min() > 300
    everything = compare(tracks, "default")[-1]
    assert everything.median_percent < 1.0
    assert everything.median_percent < 0.5 * everything.plane_percent
