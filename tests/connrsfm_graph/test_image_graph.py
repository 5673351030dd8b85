"""The chosen edges against brute force, and what happens to input that does not hang together."""

from __future__ import annotations

import itertools
import time

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from connrsfm_graph.errors import InputError
from connrsfm_graph.image_graph import GraphConfig, greedy_edges, image_change, select_edges


def log_det(n: int, pairs: np.ndarray, weight: np.ndarray, chosen) -> float:
    laplacian = np.zeros((n, n))
    for e in chosen:
        a, b = pairs[e]
        laplacian[[a, b], [a, b]] += weight[e]
        laplacian[[a, b], [b, a]] -= weight[e]
    sign, value = np.linalg.slogdet(laplacian[1:, 1:])
    return float(value) if sign > 0 else -np.inf


def random_visible(rng: np.random.Generator, n: int, p: int = 60) -> np.ndarray:
    visible = rng.random((n, p)) < rng.uniform(0.3, 0.95, (n, 1))
    visible[:, :6] = True
    return visible


def all_pairs(visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pairs = np.array(list(itertools.combinations(range(len(visible)), 2)))
    return pairs, np.array([(visible[a] & visible[b]).sum() for a, b in pairs], dtype=float)


@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_tree_is_the_best_of_all_trees(n: int, seed: int) -> None:
    visible = random_visible(np.random.default_rng(seed), n)
    graph = select_edges(visible, GraphConfig(extra_edges=0))
    pairs, weight = all_pairs(visible)
    best = max(log_det(n, pairs, weight, tree) for tree in itertools.combinations(range(len(pairs)), n - 1))
    assert graph.n_tree == len(graph.edges) == n - 1
    assert log_det(n, graph.edges, graph.weight, range(n - 1)) == pytest.approx(best, abs=1e-9)


def test_tree_is_the_best_of_all_trees_of_seven_views() -> None:
    visible = random_visible(np.random.default_rng(5), 7)
    graph = select_edges(visible, GraphConfig(extra_edges=0))
    weight = dict(zip(map(tuple, all_pairs(visible)[0].tolist()), all_pairs(visible)[1], strict=True))
    best = -np.inf
    for code in itertools.product(range(7), repeat=5):
        tree = nx.from_prufer_sequence(list(code))
        best = max(best, sum(np.log(weight[tuple(sorted(edge))]) for edge in tree.edges))
    assert np.log(graph.weight).sum() == pytest.approx(best, abs=1e-9)


@given(st.integers(4, 7), st.integers(1, 3), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_extra_edges_keep_the_guarantee_of_greedy_choice(n: int, extra: int, seed: int) -> None:
    visible = random_visible(np.random.default_rng(seed), n)
    graph = select_edges(visible, GraphConfig(extra_edges=extra))
    pairs, weight = all_pairs(visible)
    tree = [int(np.flatnonzero((pairs == edge).all(axis=1))[0]) for edge in graph.edges[: graph.n_tree]]
    rest = [e for e in range(len(pairs)) if e not in tree]
    bare = log_det(n, pairs, weight, tree)
    best = max(
        log_det(n, pairs, weight, [*tree, *more]) for more in itertools.combinations(rest, min(extra, len(rest)))
    )
    reached = log_det(n, graph.edges, graph.weight, range(len(graph.edges)))
    assert reached - bare >= (1 - 1 / np.e) * (best - bare) - 1e-9
    if extra == 1:
        assert reached == pytest.approx(best, abs=1e-9)


def test_updates_choose_what_full_evaluation_chooses() -> None:
    rng = np.random.default_rng(1)
    visible = random_visible(rng, 14)
    pairs, _ = all_pairs(visible)
    weight = rng.uniform(1, 10, len(pairs))
    start = np.arange(13)
    chosen = greedy_edges(14, pairs, weight, start, 40)
    taken = list(start)
    for e in chosen:
        values = [log_det(14, pairs, weight, [*taken, f]) if f not in taken else -np.inf for f in range(len(pairs))]
        assert e == int(np.argmax(values))
        taken.append(int(e))


def test_edges_are_unique_ordered_and_counted() -> None:
    visible = np.ones((9, 20), dtype=bool)
    graph = select_edges(visible, GraphConfig(extra_per_frame=2.0))
    assert len(graph.edges) == 8 + 18
    assert (graph.edges[:, 0] < graph.edges[:, 1]).all()
    assert len(np.unique(graph.edges, axis=0)) == len(graph.edges)
    assert (graph.weight == 20).all()
    tree = visible.shape[0] - 1
    assert len(select_edges(visible, GraphConfig(max_extra=3)).edges) == tree + 3
    assert len(select_edges(visible, GraphConfig(extra_edges=1000)).edges) == 36
    again = select_edges(visible, GraphConfig(extra_per_frame=2.0))
    np.testing.assert_array_equal(graph.edges, again.edges)


def test_weights_are_shared_tracks() -> None:
    visible = random_visible(np.random.default_rng(3), 12)
    graph = select_edges(visible)
    for (a, b), weight in zip(graph.edges, graph.weight, strict=True):
        assert weight == (visible[a] & visible[b]).sum()


def test_image_change_ignores_similarity_and_sees_deformation() -> None:
    rng = np.random.default_rng(0)
    first = rng.normal(size=(40, 2))
    turned = 1.7 * first @ np.array([[0.8, 0.6], [-0.6, 0.8]]) + [3.0, -1.0]
    bent = first + 0.3 * first**2
    image = np.stack([first, turned, bent])
    visible = np.ones((3, 40), dtype=bool)
    visible[1, 5] = False
    image[1, 5] = np.nan
    change = image_change(visible, image, np.array([[0, 1], [0, 2], [1, 2]]))
    assert change[0] == pytest.approx(0.0, abs=1e-12)
    assert change[1] > 0.01
    assert change[2] == pytest.approx(image_change(visible, image, np.array([[2, 1]]))[0], abs=1e-12)


def test_ties_go_to_medium_change() -> None:
    """Four images bent by 0, 0.001, 0.3 and 2: neither the near-identical pair nor the most different one is taken."""
    first = np.random.default_rng(0).normal(size=(40, 2))
    image = np.stack([first + bend * first[:, ::-1] ** 2 for bend in (0.0, 0.001, 0.3, 2.0)])
    edges = select_edges(np.ones((4, 40), dtype=bool), GraphConfig(extra_edges=0), image).edges.tolist()
    assert [0, 1] not in edges
    assert [0, 2] in edges
    assert [1, 2] in edges


def test_parallax_weight_avoids_images_that_look_alike() -> None:
    first = np.random.default_rng(0).normal(size=(40, 2))
    image = np.stack([first + bend * first**2 for bend in (0.0, 0.001, 0.3, 0.301)])
    visible = np.ones((4, 40), dtype=bool)
    graph = select_edges(visible, GraphConfig(weight="parallax", extra_edges=0), image)
    assert [0, 1] not in graph.edges.tolist()
    assert [2, 3] not in graph.edges.tolist()
    with pytest.raises(ValueError, match="needs the image coordinates"):
        select_edges(visible, GraphConfig(weight="parallax"))


def test_disconnected_images_are_named() -> None:
    visible = np.zeros((7, 20), dtype=bool)
    visible[[0, 1, 2, 5], :10] = True
    visible[[3, 4, 6], 10:] = True
    with pytest.raises(InputError, match=r"2 groups .*frames 0-2, 5; 3-4, 6"):
        select_edges(visible)
    with pytest.raises(InputError, match="fewer than 12 tracks"):
        select_edges(np.ones((3, 10), dtype=bool), GraphConfig(min_shared=12))
    with pytest.raises(InputError, match="at least two"):
        select_edges(np.ones((1, 10), dtype=bool))


def test_candidates_of_long_sequences_grow_until_they_link_all_images() -> None:
    """Two shuffled groups share most tracks within; the few they share with each other must still be found."""
    rng = np.random.default_rng(0)
    group = rng.permutation(np.arange(60) % 2).astype(bool)
    visible = np.zeros((60, 40), dtype=bool)
    visible[group, :20] = visible[~group, 20:] = True
    visible[[np.flatnonzero(group)[0], np.flatnonzero(~group)[-1]]] = True
    graph = select_edges(visible, GraphConfig(complete_up_to=10, neighbours=2, extra_edges=0))
    complete = select_edges(visible, GraphConfig(extra_edges=0))
    assert graph.weight.sum() == complete.weight.sum()


@pytest.mark.parametrize("full", [True, False])
def test_long_sequences_stay_quick(full: bool) -> None:
    n, p = 1600, 200
    window = np.abs(np.arange(n)[:, None] / n - np.linspace(0, 1, p)) < 0.15
    visible = np.ones((n, p), dtype=bool) if full else window
    start = time.perf_counter()
    graph = select_edges(visible, GraphConfig(extra_edges=n // 2))
    assert time.perf_counter() - start < 30.0
    assert len(graph.edges) == n - 1 + n // 2
    assert nx.is_connected(nx.Graph(graph.edges.tolist()))


@pytest.mark.parametrize(
    "chosen", [{"min_shared": 0}, {"neighbours": 0}, {"extra_per_frame": -1.0}, {"extra_edges": -1}]
)
def test_impossible_settings_are_named(chosen: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        GraphConfig(**chosen)
