"""Closed-form conformal scale of a pair, everything else given (Corollary 2).

Eleven of the 21 rows depend on the scale: in rho = lambda beta_b / beta_a the four upper extrinsic rows are
a / rho - b, the four lower ones c rho - d, and the three metric rows e - m rho^2. Their weighted sum of squares is
stationary where a polynomial of degree six vanishes; the positive root of least cost is the global minimum.
Between neighbouring roots of its derivative a polynomial is monotone, so that the roots of the derivatives, from the
last one on, bracket all roots.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from factors.conformal_pair import COLUMNS, pair_kernel, pair_workspace
from factors.noise import ROWS
from factors.surface import PERSPECTIVE, Camera

_MOST_STEPS = 100
"""Of Newton's method or bisection, towards one root; few are needed."""


@njit(cache=True, inline="always")
def _value_and_slope(p, degree, x):
    """Of the polynomial sum_k p[k] x^k."""
    value, slope = p[degree], 0.0
    for k in range(degree - 1, -1, -1):
        slope = slope * x + value
        value = value * x + p[k]
    return value, slope


@njit(cache=True, inline="always")
def _root_between(p, degree, low, high):
    """The root of a polynomial that is monotone from `low` to `high` and changes its sign there."""
    rising = _value_and_slope(p, degree, high)[0] > 0.0
    x = 0.5 * (low + high)
    for _ in range(_MOST_STEPS):
        value, slope = _value_and_slope(p, degree, x)
        if (value > 0.0) == rising:
            high = x
        else:
            low = x
        last = x
        if slope != 0.0:
            x -= value / slope
        if not low < x < high:
            x = 0.5 * (low + high)
        if abs(x - last) <= 4e-16 * last:
            break
    return x


@njit(cache=True)
def positive_roots(p):
    """Positive roots, ascending, of the polynomial sum_k p[k] x^k where it changes its sign; p[-1] is not zero."""
    n = len(p) - 1
    derivatives, roots = np.empty((n + 1, n + 1)), np.zeros(n + 2)
    bound = 0.0  # Fujiwara's, on the size of all roots of the polynomial and with it (Gauss, Lucas) of its derivatives
    for k in range(n):
        derivatives[0, k] = p[k]
        if p[k] != 0.0:
            bound = max(bound, 2.0 * abs(p[k] / p[n]) ** (1.0 / (n - k)))
    derivatives[0, n] = p[n]
    for order in range(1, n):
        for k in range(n - order + 1):
            derivatives[order, k] = (k + 1) * derivatives[order - 1, k + 1]
    count = 0
    roots[1] = bound  # the roots of a derivative stand between 0 and the bound
    for order in range(n - 1, -1, -1):
        q, degree = derivatives[order], n - order
        low, at_low, found = 0.0, q[0], 0
        for k in range(1, count + 2):
            high = roots[k]
            at_high = _value_and_slope(q, degree, high)[0]
            if (at_low < 0.0 < at_high) or (at_high < 0.0 < at_low):
                found += 1
                roots[found] = _root_between(q, degree, low, high)
            low, at_low = high, at_high
        count = found
        roots[count + 1] = bound
    return roots[1 : count + 1]


@njit(cache=True)
def scale_kernel(data, ya, yb, kappa, precision, workspace, r, J):
    """log rho of one pair that minimises the whitened rows; NaN where no row depends on it."""
    pair_kernel(data, ya, yb, 0.0, kappa, workspace[0], workspace[1], r, J, True)
    # Cost A/rho^2 - 2B/rho + C rho^2 - 2D rho + E rho^4 - 2F rho^2, read off the rows and their slope at rho = 1.
    A = B = C = D = E = F = 0.0
    for k in range(2):
        for row in (9 * k + 2, 9 * k + 5):
            p = precision[row] ** 2
            a = -J[row, 12]
            A += p * a * a
            B += p * a * (a - r[row])
        for row in (9 * k + 6, 9 * k + 7):
            p = precision[row] ** 2
            c = J[row, 12]
            C += p * c * c
            D += p * c * (c - r[row])
    for row in range(18, 21):
        p = precision[row] ** 2
        m = -0.5 * J[row, 12]
        E += p * m * m
        F += p * m * (r[row] + m)
    if not (A > 0.0 or C > 0.0 or E > 0.0):
        return np.nan
    if not (A > 0.0 or C > 0.0):
        return 0.5 * np.log(F / E) if F > 0.0 else np.nan
    slope = np.array([-A, B, 0.0, -D, C - 2.0 * F, 0.0, 2.0 * E])  # half that of the cost, times rho^3
    degree = 6
    while slope[degree] == 0.0:
        degree -= 1
    best, best_cost = np.nan, np.inf
    for rho in positive_roots(slope[: degree + 1]):
        rho2 = rho * rho
        cost = A / rho2 - 2.0 * B / rho + (C - 2.0 * F) * rho2 - 2.0 * D * rho + E * rho2 * rho2
        if cost < best_cost:
            best, best_cost = rho, cost
    return np.log(best)


@njit(cache=True, parallel=True)
def _scales(data, weight, frame, edges, kappa, precision, log_rho):
    P, E = weight.shape
    for i in prange(P):
        workspace = pair_workspace()
        r, J = np.empty(ROWS), np.empty((ROWS, COLUMNS))
        for e in range(E):
            if weight[i, e] > 0.0:
                ya, yb = frame[i, edges[e, 0], :5], frame[i, edges[e, 1], :5]
                log_rho[i, e] = scale_kernel(data[i, e], ya, yb, kappa, precision[i, e], workspace, r, J)


def closed_form_log_rho(
    data: np.ndarray,
    weight: np.ndarray,
    frame: np.ndarray,
    edges: np.ndarray,
    precision: np.ndarray,
    camera: Camera = PERSPECTIVE,
) -> np.ndarray:
    """log rho = log lambda + kappa (log beta_b - log beta_a) of every pair, shape (P, E); 0 where the weight is 0.

    Args:
        data: (P, E, 14) pair data.
        weight: (P, E), only whether it is positive matters.
        frame: (P, F, 6) variables of every point and image; the log depth is not used.
        edges: (E, 2).
        precision: (P, E, 21) reciprocal standard deviations of the rows of every pair, 0 for rows that do not count.
        camera: camera model.
    """
    log_rho = np.zeros(weight.shape)
    _scales(data, weight, frame, np.asarray(edges), camera.kappa, precision, log_rho)
    return log_rho
