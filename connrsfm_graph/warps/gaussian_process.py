"""Gaussian-process warps: a homography plus a smooth random field, with hyper-parameters of highest evidence.

    eta(x) = H(x) + c0 + C1 x + f(x),   y_p = eta(x_p) + noise,   f_l ~ GP(0, a^2 exp(-|x - x'|^2 / (2 l^2))),

the same length scale l, amplitude a and noise for both coordinates, a flat prior on the affine part (which is
integrated out: restricted likelihood). Near-planar surfaces move almost by homographies, so H leaves a smaller field to
explain than an affine mean would; on real tracks it raises the evidence and predicts left-out points better.

The kernel matrix of a smooth field has few numerically non-zero directions. A pivoted Cholesky factorisation finds
features phi with k(x, x') = phi(x) . phi(x') on the points, up to a tolerance kept far below the noise; for given l one
symmetric eigenproblem in these features gives the evidence for every noise level at once. Work is linear in the points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import solve_triangular

from connrsfm_graph.warps.homography import Homography, fit_homography
from factors.warp_jet import WarpJet

LONGEST_SCALE = 6.0
"""Longest length scale, in units of the spread of the points: on them the field is then a low-degree polynomial."""
_SCALES_PER_OCTAVE = 2
# Noise variance over amplitude^2.
_NOISE_RATIOS = 10.0 ** np.arange(-12.0, 2.01, 0.25)
# Tolerance of the features, relative to amplitude^2; the fine one is needed for (nearly) noise-free points.
_TOLERANCE, _FINE_TOLERANCE = 1e-7, 1e-13
_MAX_FEATURES = 300
# The homography's 8 parameters are estimated, not integrated out: too many for a handful of points.
_MIN_POINTS_HOMOGRAPHY = 16


@dataclass(frozen=True)
class GaussianProcessWarp:
    """A fitted Gaussian process; see `connrsfm_graph.warps.fitted.FittedWarp`."""

    settings: Mapping[str, float]
    """length_scale, amplitude, noise, log_evidence, features."""
    homography: Homography
    centres: np.ndarray
    """(R, 2) pivots of the features."""
    factor: np.ndarray
    """(R, R) Cholesky factor of the kernel matrix of the pivots."""
    field: np.ndarray
    """(R, 2) posterior mean of the feature weights, in units of the amplitude."""
    affine: np.ndarray
    """(3, 2) posterior mean of (c0, C1^T)."""
    field_root: np.ndarray
    """(R, R) root of the posterior covariance of the feature weights over the noise variance."""
    affine_root: np.ndarray
    """(3, 3) root of the covariance of the affine part given the field, over the noise variance."""
    affine_of_field: np.ndarray
    """(3, R) how the affine part gives way to the field."""
    weight: np.ndarray
    residual: np.ndarray
    leverage: np.ndarray
    model: str = "gaussian_process"

    @property
    def noise(self) -> float:
        return self.settings["noise"]

    def jet(self, points: np.ndarray, covariance: bool = True) -> WarpJet:
        scale = self.settings["length_scale"]
        kernel = _kernel_derivatives(points, self.centres, scale)
        # (N, 6, R) features and (N, 6, 3) affine functions: value, u, v, uu, uv, vv.
        features = solve_triangular(self.factor, kernel.reshape(-1, len(self.centres)).T, lower=True).T
        features = features.reshape(len(points), 6, -1)
        affine = np.zeros((len(points), 6, 3))
        affine[:, 0, 0] = affine[:, 1, 1] = affine[:, 2, 2] = 1.0
        affine[:, 0, 1:] = points
        smooth = features @ self.field + affine @ self.affine
        mean = self.homography.jet(points)
        return WarpJet(
            mean.value + smooth[:, 0],
            mean.jacobian + smooth[:, 1:3].swapaxes(1, 2),
            mean.hessian + smooth[:, 3:].swapaxes(1, 2),
            self._covariance(features[:, 1:], affine[:, 1:]) if covariance else None,
        )

    def _covariance(self, features: np.ndarray, affine: np.ndarray) -> np.ndarray:
        """(N, 10, 10) posterior covariance of the jets; the two coordinates are independent."""
        noise, amplitude, scale = (self.settings[name] for name in ("noise", "amplitude", "length_scale"))
        by_field = (features - affine @ self.affine_of_field) @ self.field_root
        by_affine = affine @ self.affine_root
        block = noise**2 * (by_field @ by_field.swapaxes(1, 2) + by_affine @ by_affine.swapaxes(1, 2))
        # What the features miss of the prior variance of the derivatives.
        block += amplitude**2 * (_prior_covariance(scale) - features @ features.swapaxes(1, 2))
        covariance = np.zeros((len(features), 10, 10))
        for index in ([0, 1, 4, 5, 6], [2, 3, 7, 8, 9]):
            covariance[:, np.array(index)[:, None], index] = block
        return covariance


def length_scales(shortest: float) -> np.ndarray:
    """(S,) length scales from the shortest to the longest, in even ratios."""
    count = 2 + int(_SCALES_PER_OCTAVE * np.log2(max(LONGEST_SCALE / shortest, 1.0)))
    return np.geomspace(shortest, max(LONGEST_SCALE, shortest), count)


def fit_gaussian_process(
    points: np.ndarray, target: np.ndarray, weight: np.ndarray, scales: np.ndarray
) -> GaussianProcessWarp:
    """Fit with the length scale, amplitude and noise of highest restricted likelihood.

    Args:
        points, target: (P, 2) in image a and in image b, both of about unit spread; at least 4 points.
        weight: (P,) in (0, 1], inverse noise variances relative to the common one.
        scales: (S,) increasing length scales to consider, S > 1; those between them are tried as well.
    """
    if len(points) >= _MIN_POINTS_HOMOGRAPHY:
        homography = fit_homography(points, target, weight)
    else:
        homography = Homography(np.zeros((2, 2)), np.zeros(2), np.zeros(2))
    rest = target - homography.jet(points).value
    fine = np.sort(np.concatenate([scales, np.sqrt(scales[:-1] * scales[1:])]))
    data = _Data.of(points, rest, weight)
    at = None
    for tolerance in (_TOLERANCE, _FINE_TOLERANCE):
        at, best = _highest_evidence(data, fine, tolerance, at)
        if best.ratio > 1e3 * tolerance:
            break
    return best.warp(points, rest, weight, homography)


def _highest_evidence(data: _Data, scales: np.ndarray, tolerance: float, near: int | None) -> tuple[int, _Evidence]:
    """Index of the best length scale and its posterior: from every fourth scale, or from one known to be near, finer
    and finer about the best."""
    tried: dict[int, _Evidence] = {}
    candidates = list(range(0, len(scales), 4)) if near is None else [near]
    for reach in (2, 1, 0):
        for index in candidates:
            if 0 <= index < len(scales) and index not in tried:
                tried[index] = _Evidence.of(data, float(scales[index]), tolerance)
        best = max(tried, key=lambda index: tried[index].log_evidence)
        candidates = [best - reach, best + reach]
    return best, tried[best]


@dataclass(frozen=True)
class _Data:
    """What does not depend on the length scale."""

    points: np.ndarray
    root: np.ndarray
    """(P, 1) square roots of the weights."""
    affine: np.ndarray
    """(P, 3) orthonormal basis of the weighted affine functions."""
    rest: np.ndarray
    """(P, 2) weighted residuals of the homography without their affine part."""

    @staticmethod
    def of(points: np.ndarray, rest: np.ndarray, weight: np.ndarray) -> _Data:
        root = np.sqrt(weight)[:, None]
        affine = np.linalg.qr(root * np.column_stack([np.ones(len(points)), points]))[0]
        rest = root * rest
        return _Data(points, root, affine, rest - affine @ (affine.T @ rest))


@dataclass(frozen=True)
class _Evidence:
    """The field's posterior for one length scale, at its best noise ratio."""

    scale: float
    ratio: float
    noise: float
    log_evidence: float
    features: np.ndarray
    pivots: np.ndarray
    eigenvalues: np.ndarray
    eigenvectors: np.ndarray
    coefficients: np.ndarray
    """(R, 2) projections of the weighted points on the eigenfeatures."""

    @staticmethod
    def of(given: _Data, scale: float, tolerance: float) -> _Evidence:
        points, data = given.points, given.rest
        features, pivots = _pivoted_cholesky(points, scale, tolerance, min(len(points), _MAX_FEATURES))
        reduced = given.root * features
        reduced -= given.affine @ (given.affine.T @ reduced)
        eigenvalues, eigenvectors = np.linalg.eigh(reduced.T @ reduced)
        eigenvalues = np.maximum(eigenvalues, 0.0)
        coefficients = eigenvectors.T @ (reduced.T @ data)
        freedom = len(points) - 3
        power = (coefficients**2).sum(axis=1)
        sums = eigenvalues[:, None] + _NOISE_RATIOS
        squares = (data**2).sum() - (power[:, None] / sums).sum(axis=0)
        # Rounding leaves no more digits than this of the explained part.
        variance = np.maximum(squares, 1e-15 * (data**2).sum() + 1e-30) / (2 * freedom)
        negative = freedom * np.log(variance) + np.log1p(eigenvalues[:, None] / _NOISE_RATIOS).sum(axis=0)
        k = int(np.argmin(negative))
        return _Evidence(
            scale, _NOISE_RATIOS[k], float(np.sqrt(variance[k])), -float(negative[k]),
            features, pivots, eigenvalues, eigenvectors, coefficients,
        )  # fmt: skip

    def warp(
        self, points: np.ndarray, rest: np.ndarray, weight: np.ndarray, homography: Homography
    ) -> GaussianProcessWarp:
        root = np.sqrt(weight)[:, None]
        q, r = np.linalg.qr(root * np.column_stack([np.ones(len(points)), points]))
        weighted = root * self.features
        affine_of_field = np.linalg.solve(r, q.T @ weighted)
        field = self.eigenvectors @ (self.coefficients / (self.eigenvalues + self.ratio)[:, None])
        affine = np.linalg.solve(r, q.T @ (root * rest)) - affine_of_field @ field
        field_root = self.eigenvectors / np.sqrt(self.eigenvalues + self.ratio)
        reduced = (weighted - q @ (q.T @ weighted)) @ field_root
        settings = {
            "length_scale": float(self.scale),
            "amplitude": float(self.noise / np.sqrt(self.ratio)),
            "noise": self.noise,
            "log_evidence": self.log_evidence,
            "features": len(self.pivots),
        }
        fitted = self.features @ field + np.column_stack([np.ones(len(points)), points]) @ affine
        return GaussianProcessWarp(
            settings=settings,
            homography=homography,
            centres=points[self.pivots],
            factor=self.features[self.pivots],
            field=field,
            affine=affine,
            field_root=field_root,
            affine_root=np.linalg.inv(r),
            affine_of_field=affine_of_field,
            weight=weight,
            residual=rest - fitted,
            leverage=np.minimum((q**2).sum(axis=1) + (reduced**2).sum(axis=1), 1.0 - 1e-9),
        )


@njit(cache=True, nogil=True)
def _pivoted_cholesky(points: np.ndarray, scale: float, tolerance: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Features (P, R) of the unit-amplitude kernel on the points, and the points (R,) they are centred on.

    Greedy: the next centre is the point whose variance the features explain least, until all are within `tolerance`.
    """
    P = len(points)
    features = np.zeros((most, P))
    pivots = np.zeros(most, np.int64)
    left = np.ones(P)
    rank = 0
    while rank < most:
        pivot = np.argmax(left)
        if left[pivot] < tolerance:
            break
        row = features[rank]
        for p in range(P):
            square = (points[p, 0] - points[pivot, 0]) ** 2 + (points[p, 1] - points[pivot, 1]) ** 2
            row[p] = np.exp(-0.5 * square / scale**2)
        for k in range(rank):
            factor = features[k, pivot]
            for p in range(P):
                row[p] -= factor * features[k, p]
        root = np.sqrt(left[pivot])
        for p in range(P):
            row[p] /= root
            left[p] -= row[p] ** 2
        for k in range(rank):
            row[pivots[k]] = 0.0
        left[pivot] = 0.0
        pivots[rank] = pivot
        rank += 1
    return features[:rank].T.copy(), pivots[:rank].copy()


def _kernel_derivatives(points: np.ndarray, centres: np.ndarray, scale: float) -> np.ndarray:
    """(N, 6, R) unit-amplitude kernel between points and centres: value, u, v, uu, uv, vv in the points."""
    u, v = np.moveaxis((points[:, None] - centres) / scale, -1, 0)
    value = np.exp(-0.5 * (u**2 + v**2))
    first = [-u / scale, -v / scale]
    second = [(u**2 - 1.0) / scale**2, u * v / scale**2, (v**2 - 1.0) / scale**2]
    return np.stack([np.ones_like(u), *first, *second], axis=1) * value[:, None]


def _prior_covariance(scale: float) -> np.ndarray:
    """(5, 5) covariance of (f_u, f_v, f_uu, f_uv, f_vv) of the unit-amplitude field at one place."""
    covariance = np.zeros((5, 5))
    covariance[[0, 1], [0, 1]] = scale**-2.0
    covariance[2:, 2:] = np.array([[3.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 3.0]]) / scale**4
    return covariance
