"""Thin-plate splines: the smoothest map of the plane through given values, with its own leave-one-out errors."""

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
    left_out: np.ndarray
    """(N', D) error at each data point of the map fitted to all others."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values (M, D) at points (M, 2)."""
        x = (x - self.centre) / self.spread
        return np.concatenate([_kernel(x, self.sites), _affine(x)], axis=1) @ self.coefficients


def fit_thin_plate(x: np.ndarray, y: np.ndarray) -> ThinPlate:
    """Map through values y (N, D) at x (N, 2); affine (of least norm, if need be) below six points."""
    centre = x.mean(axis=0)
    spread = float(np.sqrt(((x - centre) ** 2).mean())) or 1.0
    sites = (x - centre) / spread
    N, affine = len(x), _affine(sites)
    if N < _FEWEST:
        coefficients = np.linalg.lstsq(affine, y, rcond=1e-6)[0]
        return ThinPlate(centre, spread, np.empty((0, 2)), coefficients, y - affine @ coefficients)
    system = np.zeros((N + 3, N + 3))
    system[:N, :N] = _kernel(sites, sites) + _RIDGE * np.eye(N)
    system[:N, N:], system[N:, :N] = affine, affine.T
    inverse = np.linalg.pinv(system, hermitian=True)
    coefficients = inverse[:, :N] @ y
    # Leaving out one equation of an interpolation changes its prediction by coefficient / diagonal of the inverse.
    left_out = coefficients[:N] / np.diag(inverse)[:N, None]
    return ThinPlate(centre, spread, sites, coefficients, left_out)


def _kernel(x: np.ndarray, sites: np.ndarray) -> np.ndarray:
    square = ((x[:, None] - sites[None]) ** 2).sum(axis=-1)
    return 0.5 * square * np.log(np.maximum(square, 1e-300))


def _affine(x: np.ndarray) -> np.ndarray:
    return np.concatenate([np.ones((len(x), 1)), x], axis=1)
