"""Simulated surfaces and the network's frame of reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from connrsfm_graph.dense.field import normal_images
from connrsfm_graph.dense.simulated import OBSERVED, simulate
from connrsfm_graph.dense.window import Conditioned, Window, grid, slopes
from tests.connrsfm_graph.dense.surface import K, sheet, true_log_depth, true_normals


def _differences(log_depth: np.ndarray) -> np.ndarray:
    """(B, S, S, 2) gradient by window coordinates."""
    half = log_depth.shape[-1] / 2
    return np.stack(np.gradient(log_depth.astype(float), axis=(2, 1)), axis=-1) * half


def test_the_same_key_gives_the_same_batch_and_another_does_not() -> None:
    first, again, other = (simulate(3, 32, (0, 5, step), (0.0, 0.2)) for step in (7, 7, 8))
    assert (first.normals == again.normals).all()
    assert (first.m == again.m).all()
    assert not np.allclose(first.log_depth, other.log_depth)


def test_surfaces_are_polynomials_of_fifth_degree_with_their_own_normals() -> None:
    batch = simulate(8, 64, (0, 1), (0.0, 0.0))
    p = np.stack(np.meshgrid(grid(64), grid(64)), axis=-1).reshape(-1, 2)
    rows = np.stack([p[:, 0] ** i * p[:, 1] ** j for i in range(6) for j in range(6 - i)], axis=1)
    parts = (batch.log_depth, batch.mask, batch.p, batch.m, batch.observed)
    for log_depth, mask, points, m, seen in zip(*parts, strict=True):
        fitted = np.linalg.lstsq(rows, log_depth.ravel().astype(float))[0]
        assert np.abs(rows @ fitted - log_depth.ravel()).max() < 1e-5
        assert abs(log_depth[mask].mean()) < 1e-6
        # Normals at the sparse points are those of the polynomial.
        h, at = 1e-5, points[seen]
        shifted = [
            np.stack([(at + h * s)[:, 0] ** i * (at + h * s)[:, 1] ** j for i in range(6) for j in range(6 - i)], 1)
            for s in (np.zeros(2), np.array([1, 0]), np.array([0, 1]))
        ]
        base, right, down = (r @ fitted for r in shifted)
        gradient = np.stack([right - base, down - base], axis=1) / h
        gentle = np.abs(gradient).max(axis=1) < 3.0  # steeper ones are limited
        assert slopes(m[seen])[gentle] == pytest.approx(gradient[gentle], abs=2e-3)


def test_points_lie_on_the_surface_in_the_stated_number() -> None:
    batch = simulate(64, 64, (0, 2), (0.0, 0.2))
    counts = batch.observed.sum(axis=1)
    assert counts.min() >= OBSERVED[0] * 0.8
    assert counts.max() <= OBSERVED[1]
    pixel = np.round((batch.p + 1.0) * 32 - 0.5).astype(int).clip(0, 63)
    on = batch.mask[np.arange(64)[:, None], pixel[..., 1], pixel[..., 0]]
    assert on[batch.observed].mean() > 0.97  # at borders the pixel's centre may be off
    assert (batch.normals[~batch.mask] == 0).all()
    assert batch.mask.mean(axis=(1, 2)).min() > 0.3
    assert batch.mask.mean(axis=(1, 2)).max() <= 1.0


def test_noise_is_as_asked_for() -> None:
    clean, noisy = (simulate(64, 8, (0, 3), (noise, noise)) for noise in (0.0, 0.1))
    # The unit normals' noise of 0.1 turns m by about as much where the window is as wide as it is far.
    turned = np.linalg.norm((noisy.m - clean.m)[clean.observed], axis=1)
    assert 0.01 < np.median(turned) < 0.1
    assert (noisy.log_depth == clean.log_depth).all()


def test_the_image_of_normals_agrees_with_the_surface() -> None:
    batch = simulate(32, 64, (0, 4), (0.0, 0.0))
    g = slopes(np.where(batch.mask[..., None], batch.normals, 1.0))
    error = np.linalg.norm(g - _differences(batch.log_depth), axis=-1)[:, 1:-1, 1:-1][batch.mask[:, 1:-1, 1:-1]]
    scale = np.linalg.norm(_differences(batch.log_depth), axis=-1)[batch.mask].mean()
    assert np.median(error) < 0.01 * scale
    assert np.quantile(error, 0.99) < 0.2 * scale


def test_a_window_sees_the_slopes_of_any_camera() -> None:
    """With skew, and for a part of the image: the slopes are differences of log depth over the window."""
    skewed = K.copy()
    skewed[0, 1] = 12.0
    points = sheet(n_frames=1)
    window = Window.around(points.pixels[0], skewed)
    p = window.places(points.pixels[0])
    assert np.abs(p).max() == pytest.approx(1.0)
    # The same surface seen by the skewed camera: pixels move, rays and depths stay.
    rays = np.linalg.solve(K, np.append(points.pixels[0][50], 1.0))
    pixel = (skewed @ rays)[:2]
    q = (pixel - window.centre) / window.half

    def log_depth(q: np.ndarray) -> np.ndarray:
        x = np.linalg.solve(skewed, np.append(q * window.half + window.centre, 1.0))
        return true_log_depth((K @ x)[:2])

    h = 1e-5
    wanted = [(log_depth(q + h * step) - log_depth(q - h * step)) / (2 * h) for step in np.eye(2)]
    m = window.encode(true_normals((K @ rays)[:2])[None], q[None])
    assert slopes(m)[0] == pytest.approx(np.array(wanted), abs=1e-5)


@settings(max_examples=20)
@given(st.integers(0, 100), st.floats(0.1, 5.0), st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)))
def test_tilt_and_relief_are_taken_out_and_put_back(seed: int, factor: float, tilt: tuple[float, float]) -> None:
    """A tilted and scaled surface gives the network the same picture, and is restored from the same answer."""
    batch = simulate(1, 32, (0, 6, seed), (0.0, 0.0))
    g = np.where(batch.mask[..., None], slopes(np.where(batch.mask[..., None], batch.normals, 1.0)), 0.0) * 0.2
    images = []
    for slope in (g, factor * g + np.array(tilt)):
        m = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
        images.append(Conditioned.of(m / np.linalg.norm(m, axis=-1, keepdims=True), batch.mask))
    plain, changed = images
    assert changed.images == pytest.approx(plain.images, abs=1e-4)
    log_depth = 0.2 * batch.log_depth.astype(float)
    plane = tilt[0] * grid(32) + tilt[1] * grid(32)[:, None]
    answer = plain.reduced(log_depth)
    assert plain.restored(answer) == pytest.approx(log_depth, abs=1e-9)
    assert changed.restored(answer) == pytest.approx(factor * log_depth + plane, abs=1e-4)


def test_points_that_do_not_exist_have_no_say() -> None:
    batch = simulate(1, 32, (0, 7), (0.0, 0.0))
    seen = batch.observed[0]
    padded = normal_images(batch.p, batch.m, batch.observed.astype(float), 32)
    alone = normal_images(batch.p[:, seen], batch.m[:, seen], np.ones((1, seen.sum())), 32)
    assert padded == pytest.approx(alone, abs=1e-7)
