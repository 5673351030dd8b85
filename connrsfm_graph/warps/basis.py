"""Uniform cubic B-splines in two dimensions: a grid of control points and the rows that evaluate it.

A spline with `n` control points per axis has `n - 3` cells per axis. Inside a cell the value and every derivative is a
sum of the 4 x 4 control points around it, so the rows hold 16 numbers and the index of their first control point.
Unknowns are ordered (row, column, component): the two components of a warp stand side by side, which keeps the normal
equations of the coupled Schwarzian problem in a band of width `SplineGrid.bandwidth`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

VALUE, U, V, UU, UV, VV = range(6)


@dataclass(frozen=True)
class SplineGrid:
    """Square grid of control points over a rectangle."""

    n: int
    """Control points per axis, at least 4."""
    origin: np.ndarray
    """(2,) lower corner of the first cell."""
    step: np.ndarray
    """(2,) size of a cell."""

    @staticmethod
    def around(points: np.ndarray, n: int, padding: float) -> SplineGrid:
        """The grid whose cells cover the bounding box of `points` (N, 2), widened by `padding` times its size."""
        low, high = points.min(axis=0), points.max(axis=0)
        # A box that is thin along one axis would make cells that no bending energy can hold.
        margin = padding * (high - low) + 0.05 * (high - low).max()
        return SplineGrid(n, low - margin, (high - low + 2 * margin) / (n - 3))

    @property
    def bandwidth(self) -> int:
        """Sub-diagonals of the normal equations for both components."""
        return 2 * (3 * self.n + 3) + 1

    @property
    def area(self) -> float:
        """Area of all cells."""
        return float(np.prod(self.step) * (self.n - 3) ** 2)

    def rows(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the basis at points of the grid; points outside are evaluated with the nearest cell's polynomial.

        Args:
            points: (N, 2).

        Returns:
            first: (N,) index (row * n + column) of the first control point of each row.
            rows: (N, 6, 16) weights of the 4 x 4 control points for value, u, v, uu, uv, vv.
        """
        local = (np.asarray(points, dtype=float) - self.origin) / self.step
        cell = np.clip(np.floor(local).astype(np.int64), 0, self.n - 4)
        t = local - cell
        return cell[:, 0] * self.n + cell[:, 1], _tensor_rows(t[:, 0], t[:, 1], self.step)

    def evaluate(self, control: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(N, 6, C) value, u, v, uu, uv, vv of a spline with control points (n * n, C) at `points` (N, 2)."""
        first, rows = self.rows(points)
        return np.einsum("pdk,pkc->pdc", rows, control[first[:, None] + self.patch()])

    def patch(self) -> np.ndarray:
        """(16,) offsets of the 4 x 4 control points of a cell from its first one."""
        return (np.arange(4)[:, None] * self.n + np.arange(4)).reshape(16)

    def cell_rows(self, nodes: np.ndarray) -> np.ndarray:
        """(Q * Q, 6, 16) rows at a tensor grid of places `nodes` (Q,) in [0, 1] of any cell; all cells share them."""
        t = np.repeat(nodes, len(nodes)), np.tile(nodes, len(nodes))
        return _tensor_rows(*t, self.step)


def axis_rows(t: np.ndarray) -> np.ndarray:
    """(N, 3, 4) value, first and second derivative of the four cubic pieces at t in [0, 1] of a unit cell."""
    t = np.asarray(t, dtype=float)
    s = 1.0 - t
    value = np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6
    first = np.stack([-(s**2), 3 * t**2 - 4 * t, -3 * s**2 + 4 * s, t**2], axis=-1) / 2
    second = np.stack([s, 3 * t - 2, 3 * s - 2, t], axis=-1)
    return np.stack([value, first, second], axis=-2)


def _tensor_rows(tu: np.ndarray, tv: np.ndarray, step: np.ndarray) -> np.ndarray:
    hu, hv = step
    rows = np.empty((len(tu), 6, 4, 4))
    scale = np.array([1.0, hu, hv, hu**2, hu * hv, hv**2])
    _multiply(axis_rows(tu), axis_rows(tv), scale, rows)
    return rows.reshape(-1, 6, 16)


@njit(cache=True, nogil=True)
def _multiply(u, v, scale, rows):
    """Rows (N, 6, 4, 4) of both axes together from those of each (N, 3, 4), in units of `scale` (6,)."""
    for p in range(len(rows)):
        for order, (i, j) in enumerate(((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))):
            for k in range(4):
                for m in range(4):
                    rows[p, order, k, m] = u[p, i, k] * v[p, j, m] / scale[order]
