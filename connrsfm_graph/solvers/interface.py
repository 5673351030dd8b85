"""What every backend offers: one step and one minimisation of the point-wise problem.

A point's cost is the sum over its pairs of rho(|Sigma^-1/2 r|), with r the rows of the pair factor and rho half the
square or Huber's loss. Some variables are active, the others keep their values ("marginal freezing": a frozen variable
is not in the factor). Levenberg-Marquardt runs per point, since points are independent; both backends follow the same
rule, so that they can be compared step by step:

    solve (H + damping I) delta = -g;  accept if the cost does not rise: damping / 10, else damping * 10
    stop when the relative decrease falls below the tolerance, the cost vanishes or the damping exceeds 1e8.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.problem import Problem, State
from factors.noise import PairNoise

MAX_DAMPING = 1e8
MIN_DAMPING = 1e-12
VANISHING_COST = 1e-28
"""Below this a point's cost is rounding error."""


class PairModel(IntEnum):
    """Which pair factor ties two images."""

    ISOMETRIC = 0
    """The pre-step's four rows in the first-order terms (`factors.isometric_pair`); active must be ("d",)."""
    CONFORMAL = 1
    """The 21 rows of Con-NRSfM (`factors.conformal_pair`)."""


@dataclass(frozen=True)
class Levenberg:
    """Levenberg-Marquardt settings."""

    max_iterations: int = 30
    """Accepted steps at most."""
    tolerance: float = 1e-4
    """Relative decrease of a point's cost at which it has converged."""
    damping: float = 1e-3
    """Initial damping, added to the diagonal of the normal equations."""

    def __post_init__(self) -> None:
        if self.max_iterations < 0:
            raise InputError(f"levenberg.max_iterations is {self.max_iterations}, expected 0 or more")
        if not 0 <= self.tolerance < 1:
            raise InputError(f"levenberg.tolerance is {self.tolerance}, expected 0 or more, below 1")
        if not 0 <= self.damping <= MAX_DAMPING:
            raise InputError(f"levenberg.damping is {self.damping}, expected 0 to {MAX_DAMPING:g}")


@dataclass(frozen=True)
class Minimum:
    """Result of a minimisation."""

    state: State
    """Where it ended."""
    cost: np.ndarray
    """(P,) cost of every point."""
    iterations: np.ndarray
    """(P,) accepted steps of every point."""


class Backend(Protocol):
    """One of the interchangeable solvers of the point-wise problem."""

    name: str

    def step(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel = PairModel.CONFORMAL,
        damping: float = 0.0,
    ) -> State:
        """The state after one damped Gauss-Newton step of every point, accepted or not.

        Raises:
            ComputationError: the normal equations of a point are not positive definite; the message names the point.
        """
        ...

    def minimise(
        self,
        problem: Problem,
        state: State,
        active: tuple[str, ...],
        noise: PairNoise,
        model: PairModel = PairModel.CONFORMAL,
        settings: Levenberg = Levenberg(),
    ) -> Minimum:
        """Minimise over the active variables of every point, starting from `state`."""
        ...
