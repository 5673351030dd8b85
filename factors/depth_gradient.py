"""Depth from first- and second-order terms: differences of log depth between neighbours, as native GTSAM factors.

The first-order terms are the gradient d of log beta and the second-order ones give its Hessian H, so that between
neighbouring pixels i and k with dx = x_k - x_i the corrected trapezoidal rule

    log beta_k - log beta_i = (d_i + d_k) . dx / 2 + dx^T (H_i - H_k) dx / 12

is exact for polynomials of degree three along the edge. Each difference is a `BetweenFactorVector` with a sigma
proportional to |dx|; the graph is linear and one prior fixes the scale. For an orthographic camera the same holds for
beta instead of log beta.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from factors import keys
from factors.surface import PERSPECTIVE, Camera

SCALE_SIGMA = 1.0
"""Sigma of the prior that fixes the scale: mean differences do not depend on it."""


def depth_differences(
    image: np.ndarray,
    first_order: np.ndarray,
    second_order: np.ndarray,
    pairs: np.ndarray,
    camera: Camera = PERSPECTIVE,
) -> np.ndarray:
    """Log-depth differences (N,) from pixel pairs[:, 0] to pairs[:, 1].

    Args:
        image: (P, 2) normalised image coordinates.
        first_order: (P, 2).
        second_order: (P, 3), y11, y12, y22.
        pairs: (N, 2) int.
        camera: camera model.
    """
    y1, y2 = first_order.T
    # Hessian of log beta: second-order terms less the products of the first-order ones.
    hessian = second_order - camera.kappa * np.stack([y1 * y1, y1 * y2, y2 * y2], axis=-1)
    i, k = pairs.T
    dx = image[k] - image[i]
    square = np.stack([dx[:, 0] ** 2, 2.0 * dx[:, 0] * dx[:, 1], dx[:, 1] ** 2], axis=-1)
    slope = 0.5 * (first_order[i] + first_order[k])
    return (slope * dx).sum(axis=-1) + ((hessian[i] - hessian[k]) * square).sum(axis=-1) / 12.0


def depth_gradient_factor(points: tuple[int, int], view: int, difference: float, sigma: float) -> gtsam.NonlinearFactor:
    """Native factor: log depth of points[1] less that of points[0] in a view."""
    first, second = (keys.key(keys.LOG_DEPTH, point, view) for point in points)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    return gtsam.BetweenFactorVector(first, second, np.array([difference]), noise)


def depth_graph(
    image: np.ndarray,
    first_order: np.ndarray,
    second_order: np.ndarray,
    pairs: np.ndarray,
    points: np.ndarray,
    view: int,
    camera: Camera = PERSPECTIVE,
) -> gtsam.NonlinearFactorGraph:
    """All differences of one view and the prior that fixes its scale.

    Args:
        image, first_order, second_order, pairs, camera: as in `depth_differences`, for N local points.
        points: (N,) index of each local point, for the keys.
        view: index of the view.
    """
    graph = gtsam.NonlinearFactorGraph()
    for (i, k), difference in zip(
        pairs, depth_differences(image, first_order, second_order, pairs, camera), strict=True
    ):
        length = float(np.linalg.norm(image[k] - image[i]))
        if length > 0.0:
            graph.add(depth_gradient_factor((int(points[i]), int(points[k])), view, float(difference), length))
    anchor = keys.key(keys.LOG_DEPTH, int(points[0]), view)
    graph.add(gtsam.PriorFactorVector(anchor, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, SCALE_SIGMA)))
    return graph


def solve_depth(graph: gtsam.NonlinearFactorGraph, points: np.ndarray, view: int) -> np.ndarray:
    """Log depths (N,) of a linear depth graph, mean zero.

    Raises:
        RuntimeError: the differences do not connect all points.
    """
    point_keys = [keys.key(keys.LOG_DEPTH, int(point), view) for point in points]
    zero = gtsam.Values()
    for key in point_keys:
        zero.insert(key, np.zeros(1))
    delta = graph.linearize(zero).optimize()
    depth = np.array([delta.at(key)[0] for key in point_keys])
    return depth - depth.mean()


def examples(rng: np.random.Generator) -> Iterator[tuple[str, gtsam.NonlinearFactor, gtsam.Values]]:
    """A native factor at random values (see `factors.jacobian_check`)."""
    factor = depth_gradient_factor((0, 1), 2, float(rng.normal()), 0.3)
    values = gtsam.Values()
    for key in factor.keys():
        values.insert(key, rng.normal(size=1))
    yield "native", factor, values
