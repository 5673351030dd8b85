"""The normal equations of one point and Levenberg-Marquardt on them, compiled.

One small block per image and one scalar per edge: scales are eliminated edge by edge, images by block Cholesky on the
shared image graph (`block_cholesky`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from connrsfm_graph.solvers.block_cholesky import factor_and_solve
from connrsfm_graph.solvers.interface import MAX_DAMPING, MIN_DAMPING, VANISHING_COST
from factors.conformal_pair import COLUMNS, pair_kernel, pair_workspace
from factors.isometric_pair import ISOMETRIC_ROWS, isometric_kernel
from factors.noise import ROWS


@njit(cache=True)
def _pair_rows(model, data, xa, xb, log_scale, kappa, workspace, r, J, derivatives):
    """Rows of one pair in the 13 columns of the conformal pair; returns how many there are."""
    if model == 1:
        log_rho = log_scale + kappa * (xb[5] - xa[5])
        pair_kernel(data, xa[:5], xb[:5], log_rho, kappa, workspace[0], workspace[1], r, J, derivatives)
        return ROWS
    small = np.empty((ISOMETRIC_ROWS, 4))
    isometric_kernel(data, xa, xb, kappa, r, small)
    J[:ISOMETRIC_ROWS] = 0.0
    J[:ISOMETRIC_ROWS, 0:2] = small[:, 0:2]
    J[:ISOMETRIC_ROWS, 6:8] = small[:, 2:4]
    return ISOMETRIC_ROWS


@njit(cache=True)
def _whiten(r, rows, precision, weight, huber):
    """Whiten rows in place; returns the loss and the robust factor that the rows (and their Jacobian) still need."""
    root = math.sqrt(weight)
    square = 0.0
    for k in range(rows):
        r[k] = r[k] * precision[k] * root if precision[k] > 0.0 else 0.0
        square += r[k] * r[k]
    norm = math.sqrt(square)
    if norm <= huber:
        return 0.5 * square, 1.0
    return huber * (norm - 0.5 * huber), math.sqrt(huber / norm)


@njit(cache=True)
def _point_cost(model, frame, log_scale, data, weight, edges, kappa, precision, huber, scratch):
    workspace, r, J = scratch
    cost = 0.0
    for e in range(len(edges)):
        if weight[e] > 0.0:
            rows = _pair_rows(
                model, data[e], frame[edges[e, 0]], frame[edges[e, 1]], log_scale[e], kappa, workspace, r, J, False
            )
            cost += _whiten(r, rows, precision[e], weight[e], huber)[0]
    return cost


@njit(cache=True)
def pair_scratch():
    """Room for the kernel, the rows and the Jacobian of a pair."""
    return pair_workspace(), np.empty(ROWS), np.empty((ROWS, COLUMNS))


@njit(cache=True)
def point_equations(F, E, blocks, n):
    """Room for the normal equations of a point, see `linearise_point`."""
    return (
        np.empty((F, n, n)),
        np.empty((blocks, n, n)),
        np.empty((F, n)),
        np.empty((E, 2 * n)),
        np.empty(E),
        np.empty(E),
    )


@njit(cache=True)
def linearise_point(
    model, frame, log_scale, data, weight, edges, structure, columns, scaled, kappa, precision, huber, scratch, H
):
    """Normal equations of one point into H = (diagonal, lower, gradient, cross, scale, scale_gradient)."""
    workspace, r, J = scratch
    diagonal, lower, gradient, cross, scale, scale_gradient = H
    n = len(columns)
    m = 2 * n + scaled
    diagonal[:] = 0.0
    lower[:] = 0.0
    gradient[:] = 0.0
    scale[:] = 0.0
    active = np.empty(m, dtype=np.int64)
    for k in range(n):
        active[k] = columns[k]
        active[n + k] = 6 + columns[k]
    if scaled:
        active[2 * n] = 12
    row = np.empty(m)
    N = np.empty((m, m))
    g = np.empty(m)
    for e in range(len(edges)):
        if not weight[e] > 0.0:
            continue
        a, b = edges[e, 0], edges[e, 1]
        rows = _pair_rows(model, data[e], frame[a], frame[b], log_scale[e], kappa, workspace, r, J, True)
        _, robust = _whiten(r, rows, precision[e], weight[e], huber)
        N[:] = 0.0
        g[:] = 0.0
        root = math.sqrt(weight[e]) * robust
        for k in range(rows):
            if precision[e, k] == 0.0:
                continue
            f = precision[e, k] * root
            for i in range(m):
                row[i] = f * J[k, active[i]]
            s = r[k] * robust
            for i in range(m):
                t = row[i]
                if t != 0.0:
                    g[i] += t * s
                    for j in range(i + 1):
                        N[i, j] += t * row[j]
        block = lower[structure.slot[e]]
        flipped = structure.flipped[e]
        for i in range(n):
            gradient[a, i] += g[i]
            gradient[b, i] += g[n + i]
            for j in range(n):
                diagonal[a, i, j] += N[i, j] if i >= j else N[j, i]
                diagonal[b, i, j] += N[n + i, n + j] if i >= j else N[n + j, n + i]
                if flipped:
                    block[j, i] += N[n + i, j]
                else:
                    block[i, j] += N[n + i, j]
        if scaled:
            scale[e] = N[2 * n, 2 * n]
            scale_gradient[e] = g[2 * n]
            for i in range(2 * n):
                cross[e, i] = N[2 * n, i]


@njit(cache=True)
def solve_point(weight, edges, structure, scaled, damping, H, diagonal, lower, step, scale_step):
    """Solve (H + damping I) step = -gradient; False where that is not positive definite."""
    H_diagonal, H_lower, gradient, cross, scale, scale_gradient = H
    F, n = gradient.shape
    diagonal[:] = H_diagonal
    lower[:] = H_lower
    for f in range(F):
        seen = False
        for i in range(n):
            step[f, i] = -gradient[f, i]
            seen = seen or diagonal[f, i, i] != 0.0
        for i in range(n):
            diagonal[f, i, i] += damping if seen else 1.0
    if scaled:
        for e in range(len(edges)):
            if not weight[e] > 0.0:
                continue
            pivot = scale[e] + damping
            if not pivot > 0.0:
                return False
            a, b = edges[e, 0], edges[e, 1]
            c = cross[e]
            block = lower[structure.slot[e]]
            for i in range(n):
                step[a, i] += c[i] * scale_gradient[e] / pivot
                step[b, i] += c[n + i] * scale_gradient[e] / pivot
                for j in range(n):
                    diagonal[a, i, j] -= c[i] * c[j] / pivot
                    diagonal[b, i, j] -= c[n + i] * c[n + j] / pivot
                    if structure.flipped[e]:
                        block[i, j] -= c[i] * c[n + j] / pivot
                    else:
                        block[i, j] -= c[n + i] * c[j] / pivot
    if n > 0 and not factor_and_solve(structure, diagonal, lower, step):
        return False
    if scaled:
        for e in range(len(edges)):
            if weight[e] > 0.0:
                s = -scale_gradient[e]
                for i in range(n):
                    s -= cross[e, i] * step[edges[e, 0], i] + cross[e, n + i] * step[edges[e, 1], i]
                scale_step[e] = s / (scale[e] + damping)
            else:
                scale_step[e] = 0.0
    return True


@njit(cache=True)
def minimise_point(
    model, frame, log_scale, data, weight, edges, structure, columns, scaled, kappa, precision, huber, limits, single
):
    """Levenberg-Marquardt of one point in place; returns (cost, accepted steps, solvable)."""
    max_iterations, tolerance, damping = limits
    F, E, n = len(frame), len(edges), len(columns)
    scratch = pair_scratch()
    H = point_equations(F, E, len(structure.row), n)
    diagonal, lower = np.empty_like(H[0]), np.empty_like(H[1])
    step, scale_step = np.zeros((F, n)), np.zeros(E)
    trial, trial_scale = frame.copy(), log_scale.copy()
    cost = _point_cost(model, frame, log_scale, data, weight, edges, kappa, precision, huber, scratch)
    iteration = 0
    while iteration < max_iterations and (single or cost > VANISHING_COST):
        linearise_point(
            model,
            frame,
            log_scale,
            data,
            weight,
            edges,
            structure,
            columns,
            scaled,
            kappa,
            precision,
            huber,
            scratch,
            H,
        )
        while True:
            solved = solve_point(weight, edges, structure, scaled, damping, H, diagonal, lower, step, scale_step)
            if single and not solved:
                return cost, iteration, False
            if solved:
                for f in range(F):
                    for k in range(n):
                        trial[f, columns[k]] = frame[f, columns[k]] + step[f, k]
                trial_scale[:] = log_scale + scale_step
                new = _point_cost(model, trial, trial_scale, data, weight, edges, kappa, precision, huber, scratch)
                if single or new <= cost:  # false where the new cost is not a number
                    break
            damping *= 10.0
            if damping > MAX_DAMPING:
                return cost, iteration, True
        frame[:] = trial
        log_scale[:] = trial_scale
        damping = max(damping / 10.0, MIN_DAMPING)
        decrease, cost = cost - new, new
        iteration += 1
        if decrease <= tolerance * cost:
            break
    return cost, iteration, True
