"""Preconditioner that conjugate gradients leave for those that follow.

Normal equations change little from one iteration to the next, and their solutions are slow in the same directions,
slants of the surface above all. A direction and its product with the matrix are what an update of BFGS asks for; those
of former solutions so make an approximate inverse for the next one (Morales and Nocedal, Automatic preconditioning by
limited memory quasi-Newton updating, SIAM Journal on Optimization 10, 2000).
"""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
from numba import njit

KEPT = 48
"""So many directions are kept: applying them takes a sixth of the time of one product on one thread."""


class Memory:
    """The last directions of conjugate gradients with symmetric positive definite matrices that change little."""

    def __init__(self) -> None:
        self._directions = self._products = np.empty((0, 0))
        self._curvature = np.empty(0)

    def keep(self, directions: Collection[np.ndarray], products: Collection[np.ndarray]) -> None:
        """Add directions (n,) and their products with the matrix, all of positive curvature."""
        if len(directions):
            self._directions = np.array([*self._directions, *directions][-KEPT:])
            self._products = np.array([*self._products, *products][-KEPT:])
            self._curvature = (self._directions * self._products).sum(axis=1)

    def precondition(self, residual: np.ndarray, inverse: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Approximate inverse times residuals (S, n): a rougher one that is given, updated by BFGS."""
        out, share = residual.copy(), np.empty((len(residual), len(self._directions)))
        _first_loop(self._directions, self._products, self._curvature, share, out)
        out = inverse(out)
        _second_loop(self._directions, self._products, self._curvature, share, out)
        return out


@njit(cache=True)
def _first_loop(directions, products, curvature, share, x):
    """First loop of the two-loop recursion, on every row of x (S, n) in place; output `share` (S, m)."""
    for row in range(len(x)):
        for k in range(len(directions) - 1, -1, -1):
            share[row, k] = np.dot(directions[k], x[row]) / curvature[k]
            for e in range(len(x[row])):
                x[row, e] -= share[row, k] * products[k, e]


@njit(cache=True)
def _second_loop(directions, products, curvature, share, x):
    """The second loop, likewise."""
    for row in range(len(x)):
        for k in range(len(directions)):
            change = share[row, k] - np.dot(products[k], x[row]) / curvature[k]
            for e in range(len(x[row])):
                x[row, e] += change * directions[k, e]
