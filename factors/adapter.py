"""From a measurement to a GTSAM factor that cannot crash the process.

`gtsam.CustomFactor` reads the Jacobians it is given without looking at their shapes: an unfilled slot or a wrong
number of rows ends the process, a wrong number of columns gives a wrong step, and a residual that is not a number
makes the optimiser return its start in silence. `make_factor` evaluates the measurement once through a checked path
when the factor is built; `checked=True` (for factors under development) keeps the shape check in every call. Finiteness
is looked at in every call, since it depends on the values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gtsam
import numpy as np

from factors.keys import describe


class Measurement(Protocol):
    """What a factor measures: `rows` residuals of some variables and their derivatives."""

    name: str
    rows: int

    def residual(self, *x: Any) -> np.ndarray:
        """Residual, shape (rows,), not whitened."""
        ...

    def jacobians(self, *x: Any) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Residual and, for every variable in order, its derivative of shape (rows, dimension)."""
        ...


class FactorError(ValueError):
    """A factor returned something GTSAM must not see. The message names the factor and its variables."""


class _Callback:
    """The function GTSAM calls. It holds no reference to a graph, so graphs are freed by counting."""

    __slots__ = ("checked", "dims", "keys", "measurement", "readers")

    def __init__(
        self,
        measurement: Measurement,
        keys: Sequence[int],
        dims: Sequence[int],
        readers: Sequence[Callable[[gtsam.Values, int], Any]],
        checked: bool,
    ):
        self.measurement = measurement
        self.keys = keys
        self.dims = dims
        self.readers = readers
        self.checked = checked

    def __call__(self, this: Any, values: gtsam.Values, H: Any) -> np.ndarray:
        x = [read(values, k) for read, k in zip(self.readers, self.keys, strict=True)]
        if H is None:
            residual = self.measurement.residual(*x)
            if self.checked:
                self.check(residual, None)
        else:
            residual, blocks = self.measurement.jacobians(*x)
            if self.checked:
                self.check(residual, blocks)
            for slot, block in enumerate(blocks):
                H[slot] = block
        if not np.isfinite(residual).all():
            raise FactorError(f"{self.title()} is not finite: check the measurement and the initial values")
        return residual

    def title(self) -> str:
        return f"{self.measurement.name} on {', '.join(describe(k) for k in self.keys)}"

    def check(self, residual: np.ndarray, blocks: Sequence[np.ndarray] | None) -> None:
        rows = self.measurement.rows
        if np.shape(residual) != (rows,):
            raise FactorError(f"{self.title()}: residual has shape {np.shape(residual)}, expected ({rows},)")
        if blocks is None:
            return
        if len(blocks) != len(self.keys):
            raise FactorError(f"{self.title()}: {len(blocks)} Jacobian blocks for {len(self.keys)} variables")
        for k, dim, block in zip(self.keys, self.dims, blocks, strict=True):
            if np.shape(block) != (rows, dim):
                raise FactorError(
                    f"{self.title()}: Jacobian for {describe(k)} has shape {np.shape(block)}, expected ({rows}, {dim})"
                )
            if not np.isfinite(block).all():
                raise FactorError(f"{self.title()}: Jacobian for {describe(k)} is not finite")


def make_factor(
    measurement: Measurement,
    keys: Sequence[int],
    dims: Sequence[int],
    noise: gtsam.noiseModel.Base,
    *,
    example: Sequence[Any] | None = None,
    readers: Sequence[Callable[[gtsam.Values, int], Any]] | None = None,
    checked: bool = False,
) -> gtsam.CustomFactor:
    """Wrap a measurement as a `gtsam.CustomFactor`.

    Args:
        measurement: residual and Jacobians.
        keys: one key per variable.
        dims: tangent dimension of each variable.
        noise: noise model of dimension `measurement.rows`.
        example: one value per variable at which shapes are checked once, now.
        readers: how to take each variable out of `gtsam.Values`; vectors by default.
        checked: check shapes in every call, not only at `example`.

    Raises:
        FactorError: counts, shapes or the noise model's dimension do not fit.
    """
    if len(keys) != len(dims):
        raise FactorError(f"{measurement.name}: {len(keys)} keys but {len(dims)} dimensions")
    if len(set(keys)) != len(keys):
        raise FactorError(f"{measurement.name}: a variable is named twice among {[describe(k) for k in keys]}")
    if noise.dim() != measurement.rows:
        raise FactorError(f"{measurement.name}: noise model has dimension {noise.dim()}, expected {measurement.rows}")
    if readers is None:
        readers = (gtsam.Values.atVector,) * len(keys)
    callback = _Callback(measurement, tuple(keys), tuple(dims), tuple(readers), checked)
    if example is not None:
        callback.check(*measurement.jacobians(*example))
    return gtsam.CustomFactor(noise, list(keys), callback)
