"""Motion of a map point between views: the surface moves little, or its points keep their velocities.

The residual is a weighted difference of the point's positions in the world, in the reconstruction's unit of one of the
views (log scale g),

    r = exp(-g) sum_k c_k m_k,

with c = (-1, 1) for its motion over a step and c = (1/T1, -1/T1 - 1/T2, 1/T2) for the change of its velocity between
two steps of T1 and T2 views; g belongs to the first of two views, to the middle one of three. The division by the
view's scale is what GTSAM's own `BetweenFactorPoint3` lacks and why this is a factor of its own: in world units the
prior is cheapest in a small world, and the many points of a map shrink it against all that odometry says.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np

from factors.adapter import make_factor
from factors.jacobian_check import Example
from factors.keys import MAP_POINT, VIEW_SCALE, key


def motion_coefficients(views: np.ndarray | Sequence[int]) -> np.ndarray:
    """Coefficients c (..., K) of the map points of K = 2 views (motion) or 3 (change of velocity), in order of time.

    Raises:
        ValueError: not two or three views, or not in ascending order.
    """
    steps = np.diff(views)
    if steps.shape[-1] not in (1, 2) or (steps <= 0).any():
        raise ValueError(f"map motion: views {views}, expected two or three in ascending order")
    if steps.shape[-1] == 1:
        return np.concatenate([-np.ones_like(steps), np.ones_like(steps)], axis=-1).astype(float)
    first, second = np.moveaxis(1.0 / steps, -1, 0)
    return np.stack([first, -first - second, second], axis=-1)


def motion_variance(views: np.ndarray | Sequence[int]) -> np.ndarray:
    """Variance (...) of the residual in units of that of neighbouring views: motion and velocity walk at random."""
    views = np.asarray(views)
    return (views[..., -1] - views[..., 0]) / (views.shape[-1] - 1.0)


def scale_view(n_views: int) -> int:
    """Which of two or three views gives the unit."""
    return (n_views - 1) // 2


class MapMotion:
    """Three rows over the map points and the log scale g."""

    __slots__ = ("coefficients",)
    name = "map motion"
    rows = 3

    def __init__(self, coefficients: np.ndarray):
        self.coefficients = np.asarray(coefficients, dtype=float)

    def residual(self, *x: np.ndarray) -> np.ndarray:
        *points, g = x
        return np.exp(-g[0]) * (self.coefficients @ np.array(points))

    def jacobians(self, *x: np.ndarray) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        r = self.residual(*x)
        unit = np.exp(-x[-1][0]) * np.eye(3)
        return r, [*(c * unit for c in self.coefficients), -r[:, None]]


def map_motion_factor(point: int, views: Sequence[int], sigma: float) -> gtsam.CustomFactor:
    """Smoothness in time of one map point.

    Args:
        point: index of the map point.
        views: two views: the point moves little between them. Three: it changes its velocity little.
        sigma: standard deviation of a coordinate for neighbouring views, in the reconstruction's unit of depth; it
            grows with the root of the number of views in between.
    """
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma * float(motion_variance(views)) ** 0.5)
    keys = [*(key(MAP_POINT, point, view) for view in views), key(VIEW_SCALE, 0, views[scale_view(len(views))])]
    readers = (*(gtsam.Values.atPoint3,) * len(views), gtsam.Values.atVector)
    return make_factor(MapMotion(motion_coefficients(views)), keys, (*(3,) * len(views), 1), noise, readers=readers)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """Motion and change of velocity of one point, for the Jacobian check."""
    for label, views in (("motion", (2, 5)), ("velocity", (2, 3, 6))):
        factor = map_motion_factor(1, views, 0.3)
        values = gtsam.Values()
        for k in factor.keys()[:-1]:
            values.insert(k, rng.normal(size=3))
        values.insert(factor.keys()[-1], rng.normal(0.0, 0.3, 1))
        yield label, factor, values
