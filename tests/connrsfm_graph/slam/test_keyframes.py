"""Keyframes: which are chosen, what the graph of their relations knows, and the depths they give to a new view."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam import KeyframeConfig, Keyframes, View
from connrsfm_graph.synthetic import isometric_bending


def view_of(points, seed=0):
    rng = np.random.default_rng(seed)
    return View.checked(np.asarray(points), rng.normal(size=(len(points), 2)), np.zeros(len(points)))


def sliding(n, width=30, step=7):
    """Views that lose old points and win new ones; every one is news."""
    return [view_of(np.arange(step * k, step * k + width), seed=k) for k in range(n)]


def laplacian(views, edges):
    L = np.zeros((len(views), len(views)))
    for a, b in edges:
        w = len(np.intersect1d(views[a].points, views[b].points))
        L[[a, b], [a, b]] += w
        L[[a, b], [b, a]] -= w
    return L


def test_resistances_are_those_of_the_graph():
    keyframes, edges, views = Keyframes(KeyframeConfig(edges=2, min_shared=5)), [], sliding(6)
    for n, view in enumerate(views):
        if n:
            edges += [(k, n) for k in keyframes.select(view.points)]
        assert keyframes.offer(view)
    inverse = np.linalg.pinv(laplacian(views, edges))
    expected = np.add.outer(np.diag(inverse), np.diag(inverse)) - 2 * inverse
    np.testing.assert_allclose(keyframes.resistance(), expected, atol=1e-12)


def test_greedy_choice_maximises_log_det():
    """Given the heaviest edge, the second is the one with the largest determinant, by trying all."""
    keyframes, edges, views = Keyframes(KeyframeConfig(edges=2, min_shared=3)), [], sliding(5)
    for n, view in enumerate(views):
        chosen = keyframes.select(view.points) if n else []
        if n >= 2:
            shares = [k for k in range(n) if len(np.intersect1d(views[k].points, view.points)) >= 3]
            tried = {
                pair: np.linalg.det(laplacian(views[: n + 1], [*edges, (pair[0], n), (pair[1], n)])[1:, 1:])
                for pair in combinations(shares, 2)
                if chosen[0] in pair
            }
            assert set(chosen) == set(max(tried, key=tried.__getitem__))
        edges += [(k, n) for k in chosen]
        keyframes.offer(view)


def test_forgetting_a_keyframe_keeps_the_resistances_of_the_others():
    few, many = (Keyframes(KeyframeConfig(edges=2, most=most, min_shared=5)) for most in (3, 10))
    for view in sliding(4):
        few.offer(view)
        many.offer(view)
    assert len(few.views) == 3
    np.testing.assert_allclose(few.resistance(), many.resistance()[1:, 1:], atol=1e-12)


def test_policy_keeps_news_only():
    keyframes = Keyframes()
    view = view_of(range(30))
    moved = View(view.points, view.image + np.array([0.1, 0.0]), view.log_depth, view.depth_std)
    bent = View(view.points, view.image * [1.0, 0.7], view.log_depth, view.depth_std)
    assert [keyframes.offer(v) for v in (view, view, moved, bent, view_of(range(20, 50)))] == [
        True,
        False,
        False,
        True,
        True,
    ]


def test_a_view_that_shares_nothing_is_refused():
    keyframes = Keyframes()
    keyframes.offer(view_of(range(30)))
    with pytest.raises(InputError, match="shares fewer than 10 tracks with every keyframe"):
        keyframes.depths(np.arange(100, 130), np.zeros((30, 2)))


def known_views(scene, numbers, unit=0.5):
    points = np.arange(scene.tracks.n_points)
    return [View.checked(points, scene.image[k], scene.log_depth[k] + unit) for k in numbers]


def test_new_views_get_the_surface_that_the_keyframes_lengths_allow():
    """A bending sheet, seven views known: depths to a tenth of the relief, and as sure as they say."""
    scene = isometric_bending(n_frames=12, n_points=60, seed=0)
    points, keyframes = np.arange(60), Keyframes()
    for view in known_views(scene, range(7)):
        keyframes.offer(view)
    for k in range(7, 12):
        found = keyframes.depths(points, scene.image[k])
        error = found.log_depth - 0.5 - scene.log_depth[k]
        assert abs(np.median(error)) < 0.01
        assert error.std() < 0.1 * scene.log_depth[k].std()
        assert error.std() < 2.0 * np.median(found.depth_std)


def test_points_that_no_keyframe_knows_lie_on_the_surface_through_the_others():
    scene = isometric_bending(n_frames=10, n_points=60, seed=0)
    keyframes, old = Keyframes(), np.arange(50)
    for view in known_views(scene, range(7)):
        keyframes.offer(View.checked(old, view.image[old], view.log_depth[old]))
    found = keyframes.depths(np.arange(60), scene.image[7])
    error = np.abs(found.log_depth - 0.5 - scene.log_depth[7])
    assert np.median(error[50:]) < 0.3 * scene.log_depth[7].std()
    assert np.median(found.depth_std[50:]) > 2.0 * np.median(found.depth_std[:50])
    keyframes.offer(found)
    assert (
        np.median(np.abs(keyframes.depths(np.arange(60), scene.image[8]).log_depth - 0.5 - scene.log_depth[8])) < 0.01
    )
