"""Log-depth differences: exact for cubics, second-order accurate on a sphere, connected or refused."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.integrate import delaunay_edges
from connrsfm_graph.synthetic import spheres
from factors.depth_gradient import depth_differences, depth_graph, solve_depth
from factors.surface import ORTHOGRAPHIC


def test_exact_for_cubic_depths():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, size=(20, 2))
    c = rng.normal(size=(4, 4))
    powers = [(i, j) for i in range(4) for j in range(4) if i + j <= 3]

    def derivative(p, du, dv):
        total = np.zeros(len(p))
        for i, j in powers:
            if i >= du and j >= dv:
                f = np.prod(range(i - du + 1, i + 1)) * np.prod(range(j - dv + 1, j + 1))
                total += c[i, j] * f * p[:, 0] ** (i - du) * p[:, 1] ** (j - dv)
        return total

    first = np.stack([derivative(x, 1, 0), derivative(x, 0, 1)], axis=-1)
    second = np.stack([derivative(x, 2, 0), derivative(x, 1, 1), derivative(x, 0, 2)], axis=-1)
    pairs = delaunay_edges(x)
    depth = derivative(x, 0, 0)
    found = depth_differences(x, first, second, pairs, ORTHOGRAPHIC)
    assert found == pytest.approx(depth[pairs[:, 1]] - depth[pairs[:, 0]], abs=1e-12)


def test_sphere_depth_from_exact_terms():
    scene = spheres(n_frames=1, n_points=200, half_angle_deg=20)
    image = scene.image[0]
    points = np.arange(200)
    errors = []
    for order in (0.0, 1.0):
        y1, y2 = scene.first_order[0].T
        planar = np.stack([y1 * y1, y1 * y2, y2 * y2], axis=-1)
        second = planar + order * (scene.second_order[0] - planar)
        graph = depth_graph(image, scene.first_order[0], second, delaunay_edges(image), points, 0)
        depth = solve_depth(graph, points, 0)
        errors.append(np.std(depth - scene.log_depth[0]))
    assert errors[1] < 1e-4
    assert errors[1] < 0.2 * errors[0]


def test_unconnected_points_are_refused():
    image = np.array([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0]])
    graph = depth_graph(image, np.zeros((3, 2)), np.zeros((3, 3)), np.array([[0, 1]]), np.arange(3), 0)
    with pytest.raises((RuntimeError, KeyError, IndexError)):
        solve_depth(graph, np.arange(3), 0)
