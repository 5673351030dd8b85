"""Simulated training data as in the paper: smooth random surfaces, made while the network trains.

A surface is a polynomial of fifth degree for log depth over a window, fitted to random sparse 3D points. The network is
shown what a reconstruction would give it: normals at some hundred points inside a region with borders and holes,
Gaussian noise on them, and an image of normals by B-splines (`dense.field`). Batch number k of a seed is always the
same, so that training can stop and go on without keeping a generator's state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.dense.field import normal_images
from connrsfm_graph.dense.window import encode, grid

DEGREE = 5
SPARSE_POINTS = 30
"""Random 3D points that a polynomial is fitted to."""
FIELD = 0.6
"""Windows lie in normalised coordinates from -FIELD to FIELD."""
HALF_SIZE = (0.15, 0.5)
"""Range of the windows' half sides in normalised coordinates."""
SLOPE = (0.2, 1.6)
"""Range of the root mean square gradient of log depth by normalised coordinates: tilts of 11 to 58 degrees."""
OBSERVED = (60, 400)
"""Range of the number of points whose normals are known."""
CLEAN = 0.3
"""Part of the surfaces without noise, where others have some."""
HOLES = 0.3
"""Part of the surfaces with a hole."""
_FIT_RIDGE = 0.01
"""Ridge of the fit, times the square of a monomial's degree: the points bend a polynomial, they do not whip it."""

_POWERS = np.array([(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)])


@dataclass(frozen=True)
class Batch:
    """B simulated surfaces."""

    normals: np.ndarray
    """(B, size, size, 3) images of normals, see `dense.window`; 0 off the surface."""
    log_depth: np.ndarray
    """(B, size, size) true log depth; its mean over the surface is 0."""
    mask: np.ndarray
    """(B, size, size) bool, the surface."""
    p: np.ndarray
    """(B, N, 2) window coordinates of the observed points."""
    m: np.ndarray
    """(B, N, 3) their normals of the log-depth surface, with noise."""
    observed: np.ndarray
    """(B, N) bool, the point exists."""


def simulate(count: int, size: int, key: tuple[int, ...], noise: tuple[float, float]) -> Batch:
    """Simulate `count` surfaces seen in images of `size` pixels per side.

    Args:
        count, size: B and S.
        key: seeds of the batch, such as (seed, step).
        noise: range of the standard deviation of the noise on each component of the unit normals; a part `CLEAN` of the
            surfaces has none, unless the lower end is above zero.
    """
    rng = np.random.default_rng(key)
    half = rng.uniform(*HALF_SIZE, (count, 2))
    centre = rng.uniform(-1.0, 1.0, (count, 2)) * (FIELD - half)
    coefficients = _polynomials(rng, half)
    region = _Region.draw(rng, count)
    p = rng.uniform(-1.0, 1.0, (count, 2 * OBSERVED[1], 2))
    wanted = rng.integers(OBSERVED[0], OBSERVED[1] + 1, count)
    inside = region.holds(p)
    observed = inside & (np.cumsum(inside, axis=1) <= wanted[:, None])
    # Existing points first; the rest is cut off.
    order = np.argsort(~observed, axis=1, kind="stable")[:, : OBSERVED[1]]
    p, observed = np.take_along_axis(p, order[..., None], axis=1), np.take_along_axis(observed, order, axis=1)

    _, du, dv = (np.einsum("bnk,bk->bn", part, coefficients) for part in _monomials(p))
    image = centre[:, None] + p * half[:, None]
    y = np.stack([du, dv], axis=-1) / half[:, None]
    n = np.concatenate([y, -(1.0 + (y * image).sum(axis=-1, keepdims=True))], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    clean = rng.uniform(size=count) < (CLEAN if noise[0] == 0.0 else 0.0)
    sigma = np.where(clean, 0.0, rng.uniform(*noise, count))
    n += sigma[:, None, None] * rng.standard_normal(n.shape)
    m = encode(n, image, half[:, None, :, None] * np.eye(2))

    mask = region.holds(_places(size)[None]).reshape(count, size, size)
    log_depth = (coefficients @ _monomials(_places(size))[0].T).reshape(count, size, size)
    mean = (log_depth * mask).sum(axis=(1, 2)) / mask.sum(axis=(1, 2))
    images = normal_images(p, m, observed.astype(float), size) * mask[..., None]
    return Batch(
        images.astype(np.float32),
        (log_depth - mean[:, None, None]).astype(np.float32),
        mask,
        p,
        m,
        observed,
    )


@dataclass(frozen=True)
class _Region:
    """Where the surfaces are: a turned superellipse that touches the window's sides, without a disc."""

    to_unit: np.ndarray
    """(B, 2, 2) from window coordinates to those of the superellipse |x|^k + |y|^k = 1."""
    power: np.ndarray
    """(B, 1) k: 2 is an ellipse, large is a rectangle."""
    hole: np.ndarray
    """(B, 1, 2) centre of the disc."""
    radius: np.ndarray
    """(B, 1) its radius, 0 for none."""

    @staticmethod
    def draw(rng: np.random.Generator, count: int) -> _Region:
        power = np.exp(rng.uniform(np.log(2.0), np.log(200.0), (count, 1)))
        angle = rng.uniform(0.0, 2 * np.pi, count) * (rng.uniform(size=count) < 0.5)
        turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1).reshape(-1, 2, 2)
        sides = np.stack([np.ones(count), rng.uniform(0.4, 1.0, count)], axis=-1)
        around = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
        circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
        rim = circle / (np.abs(circle) ** power[..., None]).sum(axis=-1, keepdims=True) ** (1.0 / power[..., None])
        from_unit = turn * sides[:, None, :]
        reach = np.abs(np.einsum("bij,bnj->bni", from_unit, rim)).max(axis=1)
        from_unit /= reach[:, :, None]
        radius = rng.uniform(0.1, 0.35, (count, 1)) * (rng.uniform(size=(count, 1)) < HOLES)
        return _Region(np.linalg.inv(from_unit), power, rng.uniform(-0.8, 0.8, (count, 1, 2)), radius)

    def holds(self, p: np.ndarray) -> np.ndarray:
        """(B, N) bool for window coordinates (B, N, 2)."""
        unit = np.abs(p @ self.to_unit.swapaxes(1, 2))
        inside = (unit ** self.power[..., None]).sum(axis=-1) <= 1.0
        return inside & (np.linalg.norm(p - self.hole, axis=-1) >= self.radius)


def _polynomials(rng: np.random.Generator, half: np.ndarray) -> np.ndarray:
    """(B, 21) coefficients of log depth, fitted to random points and scaled to a random mean slope."""
    count = len(half)
    rows = _monomials(rng.uniform(-1.0, 1.0, (count, SPARSE_POINTS, 2)))[0]
    log_depth = rng.uniform(-1.0, 1.0, (count, SPARSE_POINTS, 1))
    ridge = _FIT_RIDGE * np.diag(_POWERS.sum(axis=1) ** 2.0 + 1e-6)
    normal = rows.swapaxes(1, 2) @ rows / SPARSE_POINTS + ridge
    coefficients = np.linalg.solve(normal, rows.swapaxes(1, 2) @ log_depth / SPARSE_POINTS)[..., 0]
    _, du, dv = (coefficients @ part.T for part in _monomials(_places(8)))
    steepness = np.sqrt(((du / half[:, :1]) ** 2 + (dv / half[:, 1:]) ** 2).mean(axis=1))
    return coefficients * (rng.uniform(*SLOPE, count) / steepness)[:, None]


def _monomials(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(..., 21) products of powers at window coordinates (..., 2), and their derivatives by both."""
    i, j = _POWERS.T
    powers = p[..., None] ** np.arange(DEGREE + 1)
    a, b = powers[..., 0, :], powers[..., 1, :]
    lower_a, lower_b = i * a[..., np.maximum(i - 1, 0)], j * b[..., np.maximum(j - 1, 0)]
    a, b = a[..., i], b[..., j]
    return a * b, lower_a * b, a * lower_b


def _places(size: int) -> np.ndarray:
    """(size * size, 2) window coordinates of an image's pixels."""
    return np.stack(np.meshgrid(grid(size), grid(size)), axis=-1).reshape(-1, 2)
