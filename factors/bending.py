"""Quadratic isometric bending of a hinge: two triangles of a mesh that share an edge.

A surface that bends without stretching keeps its intrinsic Laplacian, so its bending energy, the squared mean
curvature, is quadratic in the points (Bergou, Wardetzky, Harmon, Zorin and Grinspun 2006). For the hinge with shared
edge x0 x1 and opposite corners x2, x3 the residual is the curvature vector of the hinge in units of its size,

    r = (c0 X_0 + c1 X_1 + c2 X_2 + c3 X_3) sqrt(3 / (A_0 + A_1)),

with the cotangent weights c of the four points and the areas A of the two triangles. Weights and areas are intrinsic:
they come from the edge lengths shared by all views (`hinge_coefficients`), not from the noisy points of one view.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np
from numba import njit

from factors.adapter import make_factor
from factors.jacobian_check import Example
from factors.keys import LOG_DEPTH, RAY_CORRECTION, key

SMALLEST_AREA = 0.02
"""Area of a sliver triangle is taken as at least this times its squared longest edge."""


@njit(cache=True, inline="always")
def _cotangents(a, b, c):
    """Cotangents of the angles opposite to the sides a, b, c of a triangle, and its area (Heron)."""
    a, b, c = a * a, b * b, c * c
    square = 2.0 * (a * b + b * c + c * a) - (a * a + b * b + c * c)
    area = max(0.25 * np.sqrt(max(square, 0.0)), SMALLEST_AREA * max(a, b, c))
    return (b + c - a) / (4.0 * area), (c + a - b) / (4.0 * area), (a + b - c) / (4.0 * area), area


@njit(cache=True)
def hinge_coefficients(l01, l02, l12, l03, l13):
    """Coefficients of the four points in the hinge's residual, from the five edge lengths."""
    x1_0, x0_0, _, area_0 = _cotangents(l02, l12, l01)
    x1_1, x0_1, _, area_1 = _cotangents(l03, l13, l01)
    scale = np.sqrt(3.0 / (area_0 + area_1))
    return scale * (x1_0 + x1_1), scale * (x0_0 + x0_1), -scale * (x0_0 + x1_0), -scale * (x0_1 + x1_1)


@njit(cache=True)
def _residual(coefficients, images, b, q, derivatives):
    r = np.zeros(3)
    for j in range(4):
        z = np.exp(b[j])
        x, y = z * (images[j, 0] + q[j, 0]), z * (images[j, 1] + q[j, 1])
        c = coefficients[j]
        r[0] += c * x
        r[1] += c * y
        r[2] += c * z
        derivatives[0, 3 * j], derivatives[1, 3 * j], derivatives[2, 3 * j] = c * x, c * y, c * z
        derivatives[0, 3 * j + 1] = c * z
        derivatives[1, 3 * j + 2] = c * z
    return r


class Bending:
    """Three rows over (b, q) of four points."""

    __slots__ = ("coefficients", "images")
    name = "bending"
    rows = 3

    def __init__(self, coefficients: np.ndarray, images: np.ndarray):
        self.coefficients = np.asarray(coefficients, dtype=float)
        self.images = np.asarray(images, dtype=float)

    def residual(self, *x: np.ndarray) -> np.ndarray:
        return self.jacobians(*x)[0]

    def jacobians(self, *x: np.ndarray) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        J = np.zeros((3, 12))
        r = _residual(self.coefficients, self.images, np.concatenate(x[::2]), np.stack(x[1::2]), J)
        return r, [J[:, start:stop] for j in range(0, 12, 3) for start, stop in ((j, j + 1), (j + 1, j + 3))]


def bending_factor(
    points: Sequence[int], view: int, images: np.ndarray, lengths: np.ndarray, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Bending of the hinge (x0, x1, x2, x3), shared edge x0 x1, in one view.

    Args:
        points, view: indices of the variables, log depth and ray correction of each of the four points.
        images: (4, 2) tracked points, normalised coordinates.
        lengths: (5,) edge lengths 01, 02, 12, 03, 13, in the unit of depth; held fixed.
        noise: three-dimensional, without unit: the ratio of the hinge's curvature vector to its size.
    """
    keys = [k for point in points for k in (key(LOG_DEPTH, point, view), key(RAY_CORRECTION, point, view))]
    return make_factor(Bending(np.array(hinge_coefficients(*lengths)), images), keys, [1, 2] * 4, noise)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """A hinge at random points, for the Jacobian check."""
    images = np.array([[0.0, 0.0], [0.2, 0.1], [0.2, -0.1], [0.0, 0.2]])
    factor = bending_factor(range(4), 1, images, rng.uniform(0.8, 1.2, 5), gtsam.noiseModel.Isotropic.Sigma(3, 0.7))
    values = gtsam.Values()
    for k, dim in zip(factor.keys(), [1, 2] * 4, strict=True):
        values.insert(k, rng.normal(0.0, 0.1, dim))
    yield "hinge", factor, values
