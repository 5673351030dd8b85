"""The pair factor of Con-NRSfM: 21 virtual measurements of one point on one edge of the image graph.

A conformal map between the surfaces of images a and b, written through the image warp eta with Jacobian J, ties their
metrics and, where rotation and scale vary slowly, their connections (Chen et al. 2025):

    metric, 3 rows (eq. 9)             g_a - lambda^2 J^T g_b J
    connections, 2 x 9 (Theorem 1)     J3 Lambda Gamma_k(a) Lambda^-1 - (Gamma_l(b) J_lk) J3 - dJ3/dx_k, summed over l

with J3 = diag(J, det J), Lambda = diag(lambda, lambda, lambda^2) and lambda the local size in a over that in b. Depths
and scale enter only through rho = lambda beta_b / beta_a once the rows are written in unit-depth frames (metric
divided by beta_a^2, connections conjugated by diag(beta_b, beta_b, beta_b^2)), which is done here: the rows are
dimensionless, cannot be lowered by shrinking the depth, and leave depth itself unobserved.

Rows: 9 k + 3 r + c is entry (r, c) of the connection rows of direction k; 18, 19, 20 are the metric entries 11, 12, 22.
Variables, 13 columns: d_a (2), c_a (3), b_a (1), d_b (2), c_b (3), b_b (1), log lambda (1), with b the log depth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import gtsam
import numpy as np
from numba import njit

from factors import keys
from factors.adapter import FactorError, make_factor
from factors.noise import ROWS, PairNoise
from factors.surface import PERSPECTIVE, Camera, connection_kernel, metric_derivatives, metric_kernel
from factors.warp_jet import PAIR_DATA_SIZE

COLUMNS = 13
ACTIVE = ("d", "c", "b", "s")
"""Letters of the variables that can be active: first order, second order, log depth, log scale."""
SLOTS = {"d": ((0, 2), (6, 8)), "c": ((2, 5), (8, 11)), "b": ((5, 6), (11, 12)), "s": ((12, 13),)}
"""Columns of a letter's variables, those of image a before those of image b."""


@njit(cache=True)
def pair_workspace():
    """Scratch space of `pair_kernel`, one per thread; for compiled callers (from Python: `pair_workspace.py_func`).

    numba's cache may lose the type description of arrays that a function returns to Python when compiled callers have
    brought a copy of the function of their own.
    """
    return np.empty((2, 2, 3, 3)), np.empty((2, 2, 3, 3, 5))


@njit(cache=True)
def pair_kernel(data, ya, yb, log_rho, kappa, G, dG, r, J, derivatives):
    """Residual (21,) and, if `derivatives`, Jacobian (21, 13) of one point-edge pair.

    Args:
        data: (14,) pair data, see `factors.warp_jet`.
        ya, yb: (5,) y1, y2, y11, y12, y22 of images a and b.
        log_rho: log lambda + kappa (log beta_b - log beta_a).
        kappa: of the camera.
        G, dG: workspace.
        r, J: outputs.
    """
    ua, va, ub, vb = kappa * data[0], kappa * data[1], kappa * data[2], kappa * data[3]
    j11, j12, j21, j22 = data[4], data[5], data[6], data[7]
    det = j11 * j22 - j12 * j21
    rho = np.exp(log_rho)
    connection_kernel(ua, va, kappa, ya, G[0], dG[0], derivatives)
    connection_kernel(ub, vb, kappa, yb, G[1], dG[1], derivatives)
    A, B, dA, dB = G[0], G[1], dG[0], dG[1]
    if derivatives:
        J[:, :] = 0.0
    for k in range(2):
        # Derivatives of J and det J in direction k, and the weights of Gamma_1(b), Gamma_2(b).
        if k == 0:
            h11, h12, h21, h22 = data[8], data[9], data[11], data[12]
            w1, w2 = j11, j21
        else:
            h11, h12, h21, h22 = data[9], data[10], data[12], data[13]
            w1, w2 = j12, j22
        ddet = h11 * j22 + j11 * h22 - h12 * j21 - j12 * h21
        o = 9 * k
        for c in range(2):
            jc1 = j11 if c == 0 else j12
            jc2 = j21 if c == 0 else j22
            # Intrinsic block: J A - B J - dJ.
            r[o + c] = j11 * A[k, 0, c] + j12 * A[k, 1, c] - (h11 if c == 0 else h12)
            r[o + 3 + c] = j21 * A[k, 0, c] + j22 * A[k, 1, c] - (h21 if c == 0 else h22)
            # Lower row: det rho h_a - h_b J.
            r[o + 6 + c] = det * rho * A[k, 2, c]
            for i in range(3):
                r[o + 3 * i + c] -= (w1 * B[0, i, 0] + w2 * B[1, i, 0]) * jc1
                r[o + 3 * i + c] -= (w1 * B[0, i, 1] + w2 * B[1, i, 1]) * jc2
        # Right column: J v_a / rho - det v_b, and the corner.
        r[o + 2] = (j11 * A[k, 0, 2] + j12 * A[k, 1, 2]) / rho - det * (w1 * B[0, 0, 2] + w2 * B[1, 0, 2])
        r[o + 5] = (j21 * A[k, 0, 2] + j22 * A[k, 1, 2]) / rho - det * (w1 * B[0, 1, 2] + w2 * B[1, 1, 2])
        r[o + 8] = det * (A[k, 2, 2] - w1 * B[0, 2, 2] - w2 * B[1, 2, 2]) - ddet
        if not derivatives:
            continue
        for m in range(5):
            for c in range(2):
                jc1 = j11 if c == 0 else j12
                jc2 = j21 if c == 0 else j22
                J[o + c, m] = j11 * dA[k, 0, c, m] + j12 * dA[k, 1, c, m]
                J[o + 3 + c, m] = j21 * dA[k, 0, c, m] + j22 * dA[k, 1, c, m]
                J[o + 6 + c, m] = det * rho * dA[k, 2, c, m]
                for i in range(3):
                    J[o + 3 * i + c, 6 + m] = (
                        -(w1 * dB[0, i, 0, m] + w2 * dB[1, i, 0, m]) * jc1
                        - (w1 * dB[0, i, 1, m] + w2 * dB[1, i, 1, m]) * jc2
                    )
            J[o + 2, m] = (j11 * dA[k, 0, 2, m] + j12 * dA[k, 1, 2, m]) / rho
            J[o + 5, m] = (j21 * dA[k, 0, 2, m] + j22 * dA[k, 1, 2, m]) / rho
            J[o + 8, m] = det * dA[k, 2, 2, m]
            for i in range(3):
                J[o + 3 * i + 2, 6 + m] = -det * (w1 * dB[0, i, 2, m] + w2 * dB[1, i, 2, m])
        J[o + 2, 12] = -(j11 * A[k, 0, 2] + j12 * A[k, 1, 2]) / rho
        J[o + 5, 12] = -(j21 * A[k, 0, 2] + j22 * A[k, 1, 2]) / rho
        J[o + 6, 12] = det * rho * A[k, 2, 0]
        J[o + 7, 12] = det * rho * A[k, 2, 1]
    # Metric rows.
    a11, a12, a22 = metric_kernel(ua, va, ya[0], ya[1])
    b11, b12, b22 = metric_kernel(ub, vb, yb[0], yb[1])
    rho2 = rho * rho
    m11 = j11 * j11 * b11 + 2.0 * j11 * j21 * b12 + j21 * j21 * b22
    m12 = j11 * j12 * b11 + (j11 * j22 + j21 * j12) * b12 + j21 * j22 * b22
    m22 = j12 * j12 * b11 + 2.0 * j12 * j22 * b12 + j22 * j22 * b22
    r[18] = a11 - rho2 * m11
    r[19] = a12 - rho2 * m12
    r[20] = a22 - rho2 * m22
    if not derivatives:
        return
    J[18, 0], J[19, 0], J[19, 1], J[20, 1] = metric_derivatives(ua, va, ya[0], ya[1])
    d11, d12_1, d12_2, d22 = metric_derivatives(ub, vb, yb[0], yb[1])
    J[18, 6] = -rho2 * (j11 * j11 * d11 + 2.0 * j11 * j21 * d12_1)
    J[18, 7] = -rho2 * (j21 * j21 * d22 + 2.0 * j11 * j21 * d12_2)
    J[19, 6] = -rho2 * (j11 * j12 * d11 + (j11 * j22 + j21 * j12) * d12_1)
    J[19, 7] = -rho2 * (j21 * j22 * d22 + (j11 * j22 + j21 * j12) * d12_2)
    J[20, 6] = -rho2 * (j12 * j12 * d11 + 2.0 * j12 * j22 * d12_1)
    J[20, 7] = -rho2 * (j22 * j22 * d22 + 2.0 * j12 * j22 * d12_2)
    J[18, 12] = -2.0 * rho2 * m11
    J[19, 12] = -2.0 * rho2 * m12
    J[20, 12] = -2.0 * rho2 * m22
    for i in range(ROWS):
        J[i, 5] = -kappa * J[i, 12]
        J[i, 11] = kappa * J[i, 12]


@njit(cache=True)
def _residuals(data, ya, yb, log_rho, kappa, r):
    G, dG = pair_workspace()
    J = np.empty((ROWS, COLUMNS))
    for n in range(len(data)):
        pair_kernel(data[n], ya[n], yb[n], log_rho[n], kappa, G, dG, r[n], J, False)


def residuals(
    data: np.ndarray, ya: np.ndarray, yb: np.ndarray, log_rho: np.ndarray, camera: Camera = PERSPECTIVE
) -> np.ndarray:
    """The 21 rows of many pairs at once, shape (..., 21).

    Args:
        data: (..., 14) pair data, see `factors.warp_jet`.
        ya, yb: (..., 5) first- and second-order terms of the two images.
        log_rho: (...) log lambda + kappa (log beta_b - log beta_a).
        camera: camera model.
    """
    lead = np.shape(data)[:-1]
    flat_data, flat_a, flat_b = (
        np.ascontiguousarray(np.broadcast_to(array, (*lead, size)).reshape(-1, size), dtype=float)
        for array, size in ((data, PAIR_DATA_SIZE), (ya, 5), (yb, 5))
    )
    rho = np.ascontiguousarray(np.broadcast_to(log_rho, lead).reshape(-1), dtype=float)
    r = np.empty((len(rho), ROWS))
    _residuals(flat_data, flat_a, flat_b, rho, camera.kappa, r)
    return r.reshape(*lead, ROWS)


class ConformalPair:
    """The measurement of one pair with some variables active and the others frozen at `state`."""

    __slots__ = ("_J", "_columns", "_workspace", "data", "kappa", "name", "rows", "state")

    def __init__(self, data: np.ndarray, state: np.ndarray, active: Sequence[str], camera: Camera = PERSPECTIVE):
        self.name = "conformal pair"
        self.rows = ROWS
        self.data = np.ascontiguousarray(data, dtype=float)
        self.state = np.array(state, dtype=float)
        self.kappa = camera.kappa
        self._columns = [slice(*columns) for end in (0, 1) for columns in _columns(active, end)]
        if "s" in active:
            self._columns.append(slice(12, 13))
        self._workspace = pair_workspace.py_func()
        self._J = np.empty((ROWS, COLUMNS))

    def residual(self, *x: np.ndarray) -> np.ndarray:
        return self._evaluate(x, False)

    def jacobians(self, *x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        r = self._evaluate(x, True)
        return r, [self._J[:, columns] for columns in self._columns]

    def _evaluate(self, x: Sequence[np.ndarray], derivatives: bool) -> np.ndarray:
        state = self.state.copy()
        for columns, value in zip(self._columns, x, strict=True):
            state[columns] = value
        log_rho = state[12] + self.kappa * (state[11] - state[5])
        r = np.empty(ROWS)
        G, dG = self._workspace
        pair_kernel(self.data, state[0:5], state[6:11], log_rho, self.kappa, G, dG, r, self._J, derivatives)
        return r


def _columns(active: Sequence[str], end: int) -> list[tuple[int, int]]:
    return [SLOTS[letter][end] for letter in "dcb" if letter in active]


def conformal_pair_factor(
    point: int,
    edge: int,
    views: tuple[int, int],
    data: np.ndarray,
    state: np.ndarray,
    *,
    active: Sequence[str] = ACTIVE,
    noise: gtsam.noiseModel.Base | None = None,
    camera: Camera = PERSPECTIVE,
    checked: bool = False,
) -> gtsam.CustomFactor:
    """The pair factor of point `point` on edge `edge` between images `views` = (a, b).

    Args:
        point, edge, views: indices, used for the keys (see `factors.keys`).
        data: (14,) pair data, finite.
        state: (13,) values of all variables in column order; those of frozen variables are read from here.
        active: letters of the variables that are optimised; the others are not in the factor.
        noise: 21-dimensional noise model; unit sigmas by default.
        camera: camera model.
        checked: check shapes in every call (see `factors.adapter`).

    Raises:
        FactorError: nothing is active, a letter is unknown, or data or state have wrong shape or are not finite.
    """
    where = f"conformal pair of point {point}, edge {edge}"
    if not active or set(active) - set(ACTIVE):
        raise FactorError(f"{where}: active variables {tuple(active)} must be some of {ACTIVE}")
    for name, array, size in (("data", data, PAIR_DATA_SIZE), ("state", state, COLUMNS)):
        if np.shape(array) != (size,) or not np.isfinite(array).all():
            raise FactorError(f"{where}: {name} must be {size} finite numbers, got shape {np.shape(array)}")
    measurement = ConformalPair(data, state, active, camera)
    variables = [(letter, view) for view in views for letter in "dcb" if letter in active]
    pair_keys = [keys.key(letter, point, view) for letter, view in variables]
    if "s" in active:
        pair_keys.append(keys.key("s", point, edge))
    dims = [columns.stop - columns.start for columns in measurement._columns]
    return make_factor(
        measurement,
        pair_keys,
        dims,
        PairNoise().model() if noise is None else noise,
        example=[measurement.state[columns] for columns in measurement._columns],
        checked=checked,
    )


def examples(rng: np.random.Generator) -> Iterator[tuple[str, gtsam.NonlinearFactor, gtsam.Values]]:
    """One factor for every set of active variables and camera, at random data (see `factors.jacobian_check`)."""
    from itertools import combinations

    from factors.surface import CAMERAS

    for camera in CAMERAS.values():
        for size in range(1, len(ACTIVE) + 1):
            for active in combinations(ACTIVE, size):
                if camera.kappa == 0 and active == ("b",):
                    continue  # an orthographic pair does not see the depth at all
                data = rng.normal(scale=0.3, size=PAIR_DATA_SIZE) + np.array([0] * 4 + [1, 0, 0, 1] + [0] * 6)
                state = rng.normal(scale=0.4, size=COLUMNS)
                factor = conformal_pair_factor(
                    7, 5, (2, 3), data, state, active=active, camera=camera, noise=PairNoise(0.5, 2.0, 3.0).model(1.7)
                )
                values = gtsam.Values()
                for key in factor.keys():
                    letter, _, second = keys.decode(key)
                    columns = SLOTS[letter][0 if second in (2, 5) else 1]
                    values.insert(key, state[slice(*columns)])
                yield f"{camera.name}, active {''.join(active)}", factor, values
