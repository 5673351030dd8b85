"""Interpolated points, and how far their stated uncertainty can be trusted."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.refine.thin_plate import fit_thin_plate
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import isometric_bending, with_missing


def test_a_thin_plate_goes_through_its_points_and_keeps_affine_maps():
    rng = np.random.default_rng(0)
    x, new = rng.uniform(-3, 5, (25, 2)), rng.uniform(-3, 5, (10, 2))
    values = np.sin(x)
    assert fit_thin_plate(x, values)(x) == pytest.approx(values, abs=1e-4)
    A, t = rng.normal(size=(2, 2)), rng.normal(size=2)
    assert fit_thin_plate(x, x @ A + t)(new) == pytest.approx(new @ A + t, abs=1e-6)
    assert fit_thin_plate(x[:4], x[:4] @ A + t)(new) == pytest.approx(new @ A + t, abs=1e-6)


def test_the_deviation_of_a_thin_plate_grows_with_the_distance_to_its_points():
    x = np.random.default_rng(1).uniform(size=(40, 2))
    plate = fit_thin_plate(x, np.sin(4 * x))
    at, near, far = (plate.deviation(x.mean(axis=0)[None] + d)[0] for d in (x[0] - x.mean(axis=0), 0.7, 3.0))
    assert at < 1e-2 * near < far


@pytest.mark.parametrize("fraction", [0.3, 0.6])
def test_unseen_points_are_placed_within_their_stated_uncertainty(fraction):
    scene = isometric_bending(n_frames=8, n_points=100)
    visible = with_missing(scene.tracks, fraction).visible
    used = visible.any(axis=0)
    visible, image = visible[:, used], scene.image[:, used]
    completed = complete(np.where(visible[..., None], image, 0.0), visible, scene.log_depth[:, used])
    assert (completed.image[visible] == image[visible]).all()
    error = np.linalg.norm(completed.image - image, axis=-1)[~visible] / np.sqrt(2)
    assert 0.2 < np.median(error / completed.deviation[~visible]) < 1.5
    assert completed.deviation[visible].max() == 0.0


def test_views_without_shared_tracks_are_named():
    visible = np.zeros((2, 12), dtype=bool)
    visible[0, :7], visible[1, 7:] = True, True
    with pytest.raises(InputError, match="image 1 shares no track with the others"):
        complete(np.random.default_rng(0).uniform(size=(2, 12, 2)), visible, np.zeros((2, 12)))


def test_a_view_without_depth_is_named():
    visible = np.ones((3, 12), dtype=bool)
    log_depth = np.zeros((3, 12))
    log_depth[1] = np.nan
    with pytest.raises(InputError, match="image 1 has fewer than two points with a depth"):
        complete(np.random.default_rng(0).uniform(size=(3, 12, 2)), visible, log_depth)


def test_a_point_seen_nowhere_is_named():
    visible = np.ones((3, 12), dtype=bool)
    visible[:, 5] = False
    with pytest.raises(InputError, match="point 5 is seen in no image"):
        complete(np.random.default_rng(0).uniform(size=(3, 12, 2)), visible, np.zeros((3, 12)))


def test_a_view_needs_two_points():
    image, visible = np.random.default_rng(2).normal(size=(2, 6, 2)), np.ones((2, 6), dtype=bool)
    visible[1, 1:] = False
    with pytest.raises(InputError, match="image 1 has fewer than two points"):
        complete(image, visible, np.zeros((2, 6)))
