"""The mesh: neighbours, hinges, coinciding points, gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from connrsfm_graph.refine.mesh import Mesh, surface_mesh, triangulate


def plane_mesh(position: np.ndarray, rings: int = 2) -> Mesh:
    def log_length(pairs: np.ndarray) -> np.ndarray:
        return np.log(np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1))

    return surface_mesh(position, log_length, rings)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(3, 60))
def test_edges_are_ordered_distinct_and_leave_no_point_out(seed, n):
    mesh = plane_mesh(np.random.default_rng(seed).uniform(size=(n, 2)))
    assert (mesh.edges[:, 0] < mesh.edges[:, 1]).all()
    assert len(np.unique(mesh.edges, axis=0)) == len(mesh.edges)
    assert set(mesh.edges.ravel()) == set(range(n))
    assert sorted(mesh.order()) == list(range(n))


def test_hinges_share_their_first_two_points_and_name_their_edges():
    mesh = plane_mesh(np.random.default_rng(0).uniform(size=(30, 2)))
    triangles = {frozenset(t) for t in mesh.triangles.tolist()}
    assert len(mesh.hinges) > 20
    for (x0, x1, x2, x3), edges in zip(mesh.hinges.tolist(), mesh.hinge_edges, strict=True):
        assert {frozenset((x0, x1, x2)), frozenset((x0, x1, x3))} <= triangles
        expected = [{x0, x1}, {x0, x2}, {x1, x2}, {x0, x3}, {x1, x3}]
        assert [set(mesh.edges[e].tolist()) for e in edges] == expected


def test_the_second_ring_comes_after_the_first():
    position = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    position += np.random.default_rng(0).normal(0, 0.05, position.shape)
    one, two = plane_mesh(position, rings=1), plane_mesh(position, rings=2)
    assert len(one.edges) == one.n_near == two.n_near
    assert (two.edges[: two.n_near] == one.edges).all()
    length = np.linalg.norm(position[two.edges[:, 0]] - position[two.edges[:, 1]], axis=1)
    assert length[: two.n_near].mean() < length[two.n_near :].mean()


def test_a_point_tracked_twice_has_the_neighbours_of_its_twin_but_no_edge_to_it():
    position = np.random.default_rng(1).uniform(size=(30, 2))
    position[17] = position[4]
    mesh = plane_mesh(position)
    pairs = set(map(tuple, mesh.edges.tolist()))
    assert (4, 17) not in pairs

    def near(p: int) -> set[int]:
        return {int(k) for edge in mesh.edges[: mesh.n_near] if p in edge for k in edge} - {p}

    assert near(4) == near(17)


def test_no_triangle_bridges_a_gap():
    rng = np.random.default_rng(2)
    left, right = rng.uniform(size=(40, 2)), rng.uniform(size=(40, 2)) + np.array([5.0, 0.0])
    mesh = plane_mesh(np.concatenate([left, right]))
    assert ((mesh.triangles < 40).all(axis=1) | (mesh.triangles >= 40).all(axis=1)).all()


@pytest.mark.parametrize("position", [np.zeros((2, 2)), np.stack([np.arange(9.0), 2 * np.arange(9.0)], -1)])
def test_points_on_a_line_have_no_triangles(position):
    assert len(triangulate(position)) == 0


def test_what_is_usual_of_edges_is_so_about_each():
    """Half of the points lie ten times nearer to each other; among them, and among the others, two nearly coincide."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), axis=-1).reshape(-1, 2)
    sparse = grid + rng.uniform(-0.1, 0.1, grid.shape)
    dense = 0.1 * (grid + rng.uniform(-0.1, 0.1, grid.shape)) + [12.0, 3.5]
    position = np.concatenate([sparse, dense, sparse[27:28] + 0.05, dense[27:28] + 0.005])
    mesh = plane_mesh(position)
    length = np.linalg.norm(position[mesh.edges[:, 0]] - position[mesh.edges[:, 1]], axis=1)
    short = np.exp(mesh.usual(np.log(length))) / length > 3.0
    assert {frozenset(pair) for pair in mesh.edges[short].tolist()} == {frozenset((27, 128)), frozenset((91, 129))}
