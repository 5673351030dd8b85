"""Thin-plate splines: the smoothest map of the plane through given values, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_FEWEST = 6
"""Below this many points the map is affine."""
_RIDGE = 1e-6
"""Regularisation relative to the kernel's size: coinciding points must not make the system singular."""


@dataclass(frozen=True)
class ThinPlate:
    """A fitted map from the plane to D values."""

    centre: np.ndarray
    """(2,) and the scale below: the points are taken to zero mean and unit spread."""
    spread: float
    sites: np.ndarray
    """(N, 2) normalised data sites; (0, 2) for an affine map."""
    coefficients: np.ndarray
    """(N + 3, D) of the kernels at the sites and of 1, x, y."""
    inverse: np.ndarray
    """(N + 3, N + 3) inverse of the interpolation's system."""
    roughness: float
    """Standard deviation that leave-one-out errors show, over the one that the system predicts up to a factor."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values (M, D) at points (M, 2)."""
        return self._rows(x) @ self.coefficients

    def deviation(self, x: np.ndarray) -> np.ndarray:
        """Standard deviation (M,) of each value at points (M, 2): kriging's, small near the sites, large far out."""
        rows = self._rows(x)
        return self.roughness * np.sqrt(np.abs(np.einsum("mi,ij,mj->m", rows, self.inverse, rows)))

    def _rows(self, x: np.ndarray) -> np.ndarray:
        x = (x - self.centre) / self.spread
        return np.concatenate([_kernel(x, self.sites), _affine(x)], axis=1)


def fit_thin_plate(x: np.ndarray, y: np.ndarray) -> ThinPlate:
    """Map through values y (N, D) at x (N, 2); affine (of least norm, if need be) below six points."""
    centre = x.mean(axis=0)
    spread = float(np.sqrt(((x - centre) ** 2).mean())) or 1.0
    sites = (x - centre) / spread
    N, affine = len(x), _affine(sites)
    if N < _FEWEST:
        inverse = np.linalg.pinv(affine.T @ affine, rcond=1e-9, hermitian=True)
        coefficients = inverse @ affine.T @ y
        return ThinPlate(centre, spread, np.empty((0, 2)), coefficients, inverse, float(y.std(axis=0).max()))
    system = np.zeros((N + 3, N + 3))
    system[:N, :N] = _kernel(sites, sites) + _RIDGE * np.eye(N)
    system[:N, N:], system[N:, :N] = affine, affine.T
    inverse = np.linalg.pinv(system, hermitian=True)
    coefficients = inverse[:, :N] @ y
    # Leaving out one equation of an interpolation changes its prediction by coefficient / diagonal of the inverse; the
    # variance of that error is 1 / diagonal up to a factor.
    diagonal = np.maximum(np.abs(np.diag(inverse)[:N]), 1e-300)
    errors = np.linalg.norm(coefficients[:N], axis=1) / np.sqrt(y.shape[1] * diagonal)
    return ThinPlate(centre, spread, sites, coefficients, inverse, float(np.sqrt((errors**2).mean())))


def _kernel(x: np.ndarray, sites: np.ndarray) -> np.ndarray:
    square = ((x[:, None] - sites[None]) ** 2).sum(axis=-1)
    return 0.5 * square * np.log(np.maximum(square, 1e-300))


def _affine(x: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(x), 1)), x], axis=1)
