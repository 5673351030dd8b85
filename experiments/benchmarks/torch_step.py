"""The differential solve's damped Gauss-Newton step on a chain of images, in vectorised torch with forward derivatives.

What one would write without compiled kernels of one's own: the residuals of all pairs as one function, `torch.func` for
their Jacobians, and the normal equations eliminated image by image for all points at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch.func import jacfwd, vmap

from connrsfm_graph.problem import Problem, State
from factors.conformal_pair import SLOTS
from factors.noise import PairNoise


def make_step(
    problem: Problem, state: State, active: tuple[str, ...], noise: PairNoise, damping: float, device: str = "cpu"
) -> Callable[[], torch.Tensor]:
    """A function that computes the step (P, F, n) of the active first- and second-order terms.

    Args:
        problem: all points seen in all images, edges (0, 1), (1, 2), ...
        state: where to linearise.
        active, noise, damping: as for a backend's `step`.
        device: of torch.
    """

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=device)

    a, b = problem.edges.T
    log_scale = state.log_scale[..., None]
    variables = tensor(np.concatenate([state.frame[:, a], state.frame[:, b], log_scale], axis=-1))
    data, precision = tensor(problem.data), tensor(noise.precisions())
    own = [column for letter in "dc" if letter in active for column in range(*SLOTS[letter][0])]
    columns = own + [column + 6 for column in own] + ([12] if "s" in active else [])
    weight = tensor(problem.weight)
    n = len(own)

    def residual(free: torch.Tensor, held: torch.Tensor, pair: torch.Tensor) -> torch.Tensor:
        return precision * conformal_pair(held.index_copy(0, torch.tensor(columns, device=device), free), pair)

    jacobians = vmap(vmap(jacfwd(residual)))
    values = vmap(vmap(residual))

    def step() -> torch.Tensor:
        free = variables[..., columns]
        r, J = values(free, variables, data), jacobians(free, variables, data)
        H = torch.einsum("peri,perj,pe->peij", J, J, weight)
        g = torch.einsum("peri,per,pe->pei", J, r, weight)
        if "s" in active:  # a scale belongs to its pair alone
            pivot = H[..., -1, -1] + damping
            g = g[..., :-1] - H[..., :-1, -1] * (g[..., -1] / pivot)[..., None]
            H = H[..., :-1, :-1] - H[..., :-1, -1:] * H[..., -1:, :-1] / pivot[..., None, None]
        return along_chain(H, g, n, damping).cpu()

    return step


def along_chain(H: torch.Tensor, g: torch.Tensor, n: int, damping: float) -> torch.Tensor:
    """Step (P, F, n) from the normal equations (P, E, 2n, 2n), (P, E, 2n) of the pairs of a chain."""
    P, E = g.shape[:2]
    diagonal = torch.zeros(P, E + 1, n, n, dtype=H.dtype, device=H.device)
    diagonal[:, :-1] += H[..., :n, :n]
    diagonal[:, 1:] += H[..., n:, n:]
    diagonal += damping * torch.eye(n, dtype=H.dtype, device=H.device)
    right = torch.zeros(P, E + 1, n, dtype=H.dtype, device=H.device)
    right[:, :-1] -= g[..., :n]
    right[:, 1:] -= g[..., n:]
    factors, step = [torch.linalg.cholesky(diagonal[:, 0])], [right[:, 0]]
    for e in range(E):
        eliminated = torch.cholesky_solve(H[:, e, :n, n:], factors[e])
        factors.append(torch.linalg.cholesky(diagonal[:, e + 1] - H[:, e, n:, :n] @ eliminated))
        step.append(right[:, e + 1] - (eliminated.mT @ step[e][..., None])[..., 0])
    step[E] = torch.cholesky_solve(step[E][..., None], factors[E])[..., 0]
    for e in range(E - 1, -1, -1):
        known = step[e] - (H[:, e, :n, n:] @ step[e + 1][..., None])[..., 0]
        step[e] = torch.cholesky_solve(known[..., None], factors[e])[..., 0]
    return torch.stack(step, dim=1)


def conformal_pair(x: torch.Tensor, data: torch.Tensor) -> torch.Tensor:
    """The 21 rows of one pair (13,), (14,), perspective, as `factors.conformal_pair` has them."""
    rho = torch.exp(x[12] + x[11] - x[5])
    Ea, Ga = frame_and_connections(data[0:2], x[0:5])
    Eb, Gb = frame_and_connections(data[2:4], x[6:11])
    J = data[4:8].reshape(2, 2)
    det = torch.linalg.det(J)
    J3 = torch.block_diag(J, det[None, None])
    scale = torch.stack([rho, rho, rho * rho])
    rows = []
    for k, (first, second) in enumerate(((8, 9), (9, 10))):
        dJ = torch.stack([data[first], data[second], data[first + 3], data[second + 3]]).reshape(2, 2)
        ddet = det * (torch.linalg.solve(J, dJ)).trace()
        dJ3 = torch.block_diag(dJ, ddet[None, None])
        transported = (Gb * J[:, k, None, None]).sum(dim=0)
        rows.append(J3 @ (Ga[k] * scale[:, None] / scale) - transported @ J3 - dJ3)
    g = Ea.T @ Ea - rho * rho * (J.T @ (Eb.T @ Eb) @ J)
    return torch.cat([rows[0].ravel(), rows[1].ravel(), torch.stack([g[0, 0], g[0, 1], g[1, 1]])])


def frame_and_connections(image: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Tangents (3, 2) and connections (2, 3, 3) of the unit-depth frame (eqs. 4 and 7)."""
    p = torch.cat([image, torch.ones_like(image[:1])])
    axes = torch.eye(3, dtype=y.dtype, device=y.device)
    e1, e2 = axes[0] + y[0] * p, axes[1] + y[1] * p
    e11 = y[2] * p + 2.0 * y[0] * axes[0]
    e12 = y[3] * p + y[0] * axes[1] + y[1] * axes[0]
    e22 = y[4] * p + 2.0 * y[1] * axes[1]
    n, n1, n2 = (torch.linalg.cross(a, b) for a, b in ((e1, e2), (e11, e2), (e12, e2)))
    n1, n2 = n1 + torch.linalg.cross(e1, e12), n2 + torch.linalg.cross(e1, e22)
    E = torch.stack([e1, e2, n], dim=1)
    derivatives = torch.stack([torch.stack([e11, e12, n1], dim=1), torch.stack([e12, e22, n2], dim=1)])
    dual = torch.stack([torch.linalg.cross(e2, n), torch.linalg.cross(n, e1), n]) / n.square().sum()
    return E[:, :2], dual @ derivatives
