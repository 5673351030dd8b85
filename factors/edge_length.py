"""Isometry and discrete conformal equivalence: a chord of a view against the latent length of a mesh edge.

Points i and k, joined by an edge of a mesh on the surface, are seen in view j on corrected sight rays:
X = exp(b) (x + q, 1) with log depth b, tracked image point x and ray correction q. The residual is

    r = log |X_i - X_k| + a - e - (f_i + f_k) / 2 - stretch(h),

with e the log length of the edge, shared by all views. Without the last two terms it says that views are isometric.
With the log conformal factors f it is discrete conformal equivalence (Springborn, Schroeder and Pinkall 2008), which
Moebius maps fulfil exactly, chord by chord. With the homogeneous strain h of the view it says that the views are
isometric but for a pull of the whole surface along one direction (see `stretch_kernel`). The offset a turns the chord
into an arc: over a surface curve that leaves the chord at known angles it is `arc_offset`, and zero where the chord
itself is meant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np
from numba import njit

from factors.adapter import make_factor
from factors.jacobian_check import Example
from factors.keys import LOG_DEPTH, LOG_FACTOR, LOG_LENGTH, RAY_CORRECTION, STRAIN, key


@njit(cache=True, inline="always")
def log_chord_kernel(xi, yi, zi, xk, yk, zk):
    """Log chord length and its derivatives with respect to (b, q1, q2) of the first and of the second point.

    The arguments are the coordinates of both points in the camera frame; since X = z (x + q, 1), the derivative of a
    point with respect to its log depth is the point, and with respect to the ray correction z times the unit vector.
    Of points at one place the derivatives are 0 and the length is next to nothing.
    """
    dx, dy, dz = xi - xk, yi - yk, zi - zk
    square = max(dx * dx + dy * dy + dz * dz, 1e-300)
    gx, gy, gz = dx / square, dy / square, dz / square
    return (
        0.5 * np.log(square),
        gx * xi + gy * yi + gz * zi,
        gx * zi,
        gy * zi,
        -(gx * xk + gy * yk + gz * zk),
        -gx * zk,
        -gy * zk,
    )


@njit(cache=True, inline="always")
def arc_offset(angle_i, angle_k):
    """Log ratio of arc to chord of a smooth curve that rises from the chord at these angles at its two ends.

    To second order it is the mean of y'^2 / 2 of the cubic with these end slopes; both angles are measured in the same
    direction along the chord. For a circle (opposite angles a) it is a^2 / 6, that is length^2 / (24 R^2).
    """
    return (2.0 * angle_i * angle_i + 2.0 * angle_k * angle_k - angle_i * angle_k) / 30.0


@njit(cache=True, inline="always")
def stretch_kernel(a, b, c, s):
    """Change of an edge's log length under the homogeneous strain (a, b), and its derivatives by a and by b.

    The strain multiplies vectors of the surface by exp([[a, b], [b, -a]]), which keeps areas: lengths along its axis
    grow by exp(r), those across shrink by as much, r^2 = a^2 + b^2. For an edge of direction t in the surface's own
    plane coordinates, c = cos 2t and s = sin 2t, the change is log(cosh 2r + sinh(2r) / r (a c + b s)) / 2, which is
    a c + b s to first order.
    """
    square = 4.0 * (a * a + b * b)
    if square < 1e-3:  # series, to rounding
        even = 1.0 + square / 2.0 + square * square / 24.0 + square**3 / 720.0
        odd = 2.0 * (1.0 + square / 6.0 + square * square / 120.0 + square**3 / 5040.0)
        odd_rate = 8.0 / 3.0 * (1.0 + square / 10.0 + square * square / 280.0)
    else:
        twice = np.sqrt(square)
        even, odd = np.cosh(twice), 2.0 * np.sinh(twice) / twice
        odd_rate = 4.0 * (2.0 * even - odd) / square
    along = a * c + b * s
    w = even + odd * along
    rate = 2.0 * odd + odd_rate * along
    return 0.5 * np.log(w), 0.5 * (rate * a + odd * c) / w, 0.5 * (rate * b + odd * s) / w


@njit(cache=True)
def _residual(image_i, image_k, offset, b_i, q_i, b_k, q_k, e, derivatives):
    z_i, z_k = np.exp(b_i[0]), np.exp(b_k[0])
    chord = log_chord_kernel(
        z_i * (image_i[0] + q_i[0]),
        z_i * (image_i[1] + q_i[1]),
        z_i,
        z_k * (image_k[0] + q_k[0]),
        z_k * (image_k[1] + q_k[1]),
        z_k,
    )
    for c in range(6):
        derivatives[c] = chord[1 + c]
    return chord[0] + offset - e[0]


class EdgeLength:
    """One row over (b_i, q_i, b_k, q_k, e) and, in conformal use, (f_i, f_k), or with a direction h."""

    __slots__ = ("direction", "image_i", "image_k", "offset")
    name = "edge length"
    rows = 1

    def __init__(
        self, image_i: np.ndarray, image_k: np.ndarray, offset: float, direction: tuple[float, float] | None = None
    ):
        self.image_i = np.asarray(image_i, dtype=float)
        self.image_k = np.asarray(image_k, dtype=float)
        self.offset = float(offset)
        self.direction = direction

    def residual(self, *x: np.ndarray) -> np.ndarray:
        return self.jacobians(*x)[0]

    def jacobians(self, *x: np.ndarray) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        gradient = np.empty((1, 6))
        z_i, correction_i, z_k, correction_k, length = x[:5]
        r = _residual(
            self.image_i, self.image_k, self.offset, z_i, correction_i, z_k, correction_k, length, gradient[0]
        )
        blocks = [gradient[:, :1], gradient[:, 1:3], gradient[:, 3:4], gradient[:, 4:], np.array([[-1.0]])]
        if self.direction is not None:
            stretch, *by_strain = stretch_kernel(x[5][0], x[5][1], self.direction[0], self.direction[1])
            r -= stretch
            blocks.append(-np.array([by_strain]))
        elif len(x) == 7:
            r -= 0.5 * (x[5][0] + x[6][0])
            blocks += [np.array([[-0.5]]), np.array([[-0.5]])]
        return np.array([r]), blocks


def edge_length_factor(
    edge: int,
    point_i: int,
    point_k: int,
    view: int,
    image_i: np.ndarray,
    image_k: np.ndarray,
    noise: gtsam.noiseModel.Base,
    offset: float = 0.0,
    conformal: bool = False,
    direction: tuple[float, float] | None = None,
) -> gtsam.CustomFactor:
    """The chord of mesh edge `edge` in one view against its latent log length.

    Args:
        edge, point_i, point_k, view: indices of the variables: log depths and ray corrections of both points in the
            view, the log length of the edge and, if `conformal`, the log conformal factors of both points, or else,
            with a direction, the strain of the view.
        image_i, image_k: (2,) tracked points, normalised coordinates.
        noise: one-dimensional noise of the log length, robust or not.
        offset: log ratio of arc to chord, see `arc_offset`.
        conformal: compare up to the conformal factors of the two points.
        direction: cosine and sine of twice the edge's angle on the surface: compare up to a homogeneous strain.

    Raises:
        ValueError: both conformal and with a direction.
    """
    if conformal and direction is not None:
        raise ValueError("an edge length is compared up to conformal factors or up to a strain, not both")
    keys = [
        key(LOG_DEPTH, point_i, view),
        key(RAY_CORRECTION, point_i, view),
        key(LOG_DEPTH, point_k, view),
        key(RAY_CORRECTION, point_k, view),
        key(LOG_LENGTH, edge),
    ]
    dims = [1, 2, 1, 2, 1]
    if conformal:
        keys += [key(LOG_FACTOR, point_i, view), key(LOG_FACTOR, point_k, view)]
        dims += [1, 1]
    if direction is not None:
        keys.append(key(STRAIN, 0, view))
        dims.append(2)
    return make_factor(EdgeLength(image_i, image_k, offset, direction), keys, dims, noise)


def examples(rng: np.random.Generator) -> Iterator[Example]:
    """Isometric, conformal and strained factors at random points, for the Jacobian check."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    along = (float(np.cos(angle)), float(np.sin(angle)))
    for name, direction, last, size in (
        ("isometric", None, (), 0.2),
        ("conformal", None, (1, 1), 0.2),
        ("strained", along, (2,), 0.2),
        ("hardly strained", along, (2,), 1e-3),
    ):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.3)
        image_i, image_k = rng.normal(0, 0.4, (2, 2))
        factor = edge_length_factor(2, 0, 1, 3, image_i, image_k, noise, 0.01, name == "conformal", direction)
        values = gtsam.Values()
        deviations = [np.full(dim, 0.2) for dim in (1, 2, 1, 2, 1)] + [np.full(dim, size) for dim in last]
        for k, deviation in zip(factor.keys(), deviations, strict=True):
            values.insert(k, rng.normal(0.0, deviation))
        yield name, factor, values
