"""Noise levels and stated uncertainties on simulated data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.refine import RefineConfig, refine, uncertainty
from connrsfm_graph.refine.measurements import Measurements, Shape
from connrsfm_graph.refine.mesh import surface_mesh
from connrsfm_graph.refine.noise import Noise, neighbour_correlation
from connrsfm_graph.refine.solve import minimise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.task import Task
from connrsfm_graph.refine.uncertainty import log_depth_deviation, pull
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, spheres, with_noise


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_depth_errors_are_as_large_as_stated(seed):
    scene = isometric_bending(n_frames=8, n_points=100, seed=seed)
    tracks = with_noise(scene.tracks, 1.0, seed=seed)
    sigma = 1.0 / tracks.focal_length()
    found = refine(tracks.normalised(), tracks.visible, scene.log_depth, RefineConfig(), sigma)
    error = found.log_depth - scene.log_depth
    normalised = (error - np.median(error)) / (found.depth_std / np.exp(found.log_depth))
    # Errors of neighbours are alike: of the 800 depths some tens are independent.
    assert 0.4 < (normalised**2).mean() < 1.8
    assert 0.87 < (np.abs(normalised) < 1.96).mean() < 0.995


def test_noise_is_recognised_and_lengths_are_trusted_more():
    scene = spheres(n_frames=6, n_points=80)
    tracks = with_noise(scene.tracks, 2.0)
    sigma = 2.0 / tracks.focal_length()
    found = refine(tracks.normalised(), tracks.visible, scene.log_depth, RefineConfig(), sigma)
    assert found.evidence["image noise"] == pytest.approx(sigma)
    assert found.evidence["length noise"] < RefineConfig().length_sigma


def test_corrections_that_neighbours_share_are_no_noise():
    rng = np.random.default_rng(0)
    position = rng.uniform(size=(150, 2))
    mesh = surface_mesh(position, lambda pairs: np.zeros(len(pairs)))
    seen = np.ones((6, 150), dtype=bool)
    correlation, error = neighbour_correlation(rng.normal(size=(6, 150, 2)), seen, mesh)
    assert abs(correlation) < 4 * error
    smooth = np.repeat(np.sin(6 * position)[None], 6, axis=0)
    assert neighbour_correlation(smooth, seen, mesh)[0] > 0.3


def test_the_same_input_gives_the_same_result():
    scene = isometric_bending(n_frames=4, n_points=40)
    tracks = with_noise(scene.tracks, 1.0)
    first, second = (
        refine(tracks.normalised(), tracks.visible, scene.log_depth, RefineConfig(), 2e-3) for _ in range(2)
    )
    assert (first.points == second.points).all()
    assert (first.depth_std == second.depth_std).all()


@pytest.mark.parametrize("strained", [False, True])
def test_the_pull_of_the_prior_on_slants_is_how_far_it_moves_the_minimum(strained: bool) -> None:
    """Of shapes and lengths; and of a further view, whose lengths it moves with them."""
    scene = isometric_bending(n_frames=6, n_points=40, seed=1)
    image, seen = scene.tracks.normalised(), scene.tracks.visible
    task = Task.of(complete(image, seen, scene.log_depth), seen, RefineConfig())
    noise = Noise.start(1e-3, 0.01, task.spacing())
    shape = start_shape(task.completed, task.mesh)
    shape = replace(shape, strain=np.zeros((6, 2))) if strained else shape

    def minimum(patches: int) -> tuple[Measurements, Shape]:
        measurements = task.measurements(replace(noise, patches=patches), conformal=False)
        return measurements, minimise(measurements, shape, 40, 1e-9, closely=True)[0]

    (measurements, middle), (_, less), (_, more) = (minimum(patches) for patches in (4, 3, 5))
    depths, lengths = pull(measurements, middle)
    assert depths.mean() == pytest.approx(0.0, abs=1e-12)
    scale = (more.log_depth - less.log_depth).mean()
    for found, moved in ((depths, more.log_depth - less.log_depth), (lengths, more.log_length - less.log_length)):
        assert np.abs(found).max() > 5e-4
        # What the derivatives leave out, as of arcs, is left out here, too.
        assert np.linalg.norm(found - 4 / 2 * (moved - scale)) < 0.25 * np.linalg.norm(found)
    if not strained:
        kept = replace(measurements, frontal=np.zeros_like(lengths))
        nothing = np.zeros_like(lengths)
        by_noise = log_depth_deviation(kept, middle, stretch=False, lengths_pull=nothing) ** 2
        further = log_depth_deviation(measurements, middle, stretch=False, lengths_pull=lengths) ** 2
        np.testing.assert_allclose(further - by_noise, uncertainty._around(depths**2, task.mesh), rtol=0.01, atol=1e-11)
