"""Numbers that carry their derivatives: 2-jets of functions of two variables (s, t).

A scene is written as plain formulas; evaluated on jets they give value, gradient and second derivatives at once and
to machine precision, so that the truth of depth derivatives and warps needs no differencing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

PAIRS = ((0, 0), (0, 1), (1, 1))
"""Second derivatives in the order of the data: ss, st, tt."""


class Jet:
    """Value and derivatives of an array of functions: `data` (6, ...) holds f, f_s, f_t, f_ss, f_st, f_tt.

    Arithmetic with plain arrays and numbers takes them as constants; shapes broadcast as in NumPy.
    """

    __slots__ = ("data",)
    __array_ufunc__ = None  # array * jet is left to the jet

    def __init__(self, data: np.ndarray) -> None:
        self.data = data

    @staticmethod
    def variables(s: np.ndarray, t: np.ndarray) -> tuple[Jet, Jet]:
        """The two variables at points (P,)."""
        zero, one = np.zeros_like(s), np.ones_like(s)
        return Jet(np.stack([s, one, zero, zero, zero, zero])), Jet(np.stack([t, zero, one, zero, zero, zero]))

    @staticmethod
    def stack(jets: Sequence[Jet]) -> Jet:
        """A vector of jets, its components along the first axis."""
        return Jet(np.stack(np.broadcast_arrays(*(jet.data for jet in jets)), axis=1))

    @property
    def value(self) -> np.ndarray:
        return self.data[0]

    @property
    def gradient(self) -> np.ndarray:
        """(2, ...)"""
        return self.data[1:3]

    @property
    def hessian(self) -> np.ndarray:
        """(3, ...) ss, st, tt."""
        return self.data[3:]

    def __getitem__(self, component: int) -> Jet:
        return Jet(self.data[:, component])

    def _through(self, value: np.ndarray, first: np.ndarray, second: np.ndarray) -> Jet:
        """h(f) from h, h', h'' at f (chain rule)."""
        g, h = self.gradient, self.hessian
        curved = [first * h[n] + second * g[i] * g[j] for n, (i, j) in enumerate(PAIRS)]
        return Jet(np.stack([value, first * g[0], first * g[1], *curved]))

    def __add__(self, other: Jet | np.ndarray | float) -> Jet:
        if isinstance(other, Jet):
            return Jet(self.data + other.data)
        value = self.value + other
        return Jet(np.concatenate([value[None], np.broadcast_to(self.data[1:], (5, *value.shape))]))

    def __neg__(self) -> Jet:
        return Jet(-self.data)

    def __sub__(self, other: Jet | np.ndarray | float) -> Jet:
        return self + (-other)

    def __rsub__(self, other: np.ndarray | float) -> Jet:
        return -self + other

    def __mul__(self, other: Jet | np.ndarray | float) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.data * other)
        f, g = self.data, other.data
        first = [f[k] * g[0] + f[0] * g[k] for k in (1, 2)]
        second = [
            f[3 + n] * g[0] + f[1 + i] * g[1 + j] + f[1 + j] * g[1 + i] + f[0] * g[3 + n]
            for n, (i, j) in enumerate(PAIRS)
        ]
        return Jet(np.stack([f[0] * g[0], *first, *second]))

    def __truediv__(self, other: Jet | np.ndarray | float) -> Jet:
        return self * other**-1.0 if isinstance(other, Jet) else Jet(self.data / other)

    def __pow__(self, exponent: float) -> Jet:
        f = self.value
        return self._through(
            f**exponent,
            exponent * f ** (exponent - 1.0),
            exponent * (exponent - 1.0) * f ** (exponent - 2.0),
        )

    __radd__ = __add__
    __rmul__ = __mul__

    def log(self) -> Jet:
        return self._through(np.log(self.value), 1.0 / self.value, -(self.value**-2.0))

    def sin(self) -> Jet:
        return self._through(np.sin(self.value), np.cos(self.value), -np.sin(self.value))

    def arctan(self) -> Jet:
        slope = 1.0 / (1.0 + self.value**2)
        return self._through(np.arctan(self.value), slope, -2.0 * self.value * slope**2)

    def squared_norm(self) -> Jet:
        """Squared length of a vector of jets."""
        return Jet((self * self).data.sum(axis=1))

    def rotated(self, R: np.ndarray) -> Jet:
        """R applied to a vector of jets."""
        return Jet(np.einsum("ij,kj...->ki...", R, self.data))

    def over(self, plane: Jet) -> Jet:
        """The same functions as functions of other coordinates: the jet of f o q^-1 at q, for q = `plane` (2, ...).

        With A = dq/d(s, t): grad = A^-T grad_st f, and Hess = A^-T (Hess_st f - sum_l grad_l Hess_st q_l) A^-1.
        """
        (a, b), (c, d) = plane[0].gradient, plane[1].gradient
        inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)  # inverse[k, l] = d(s, t)_k / d q_l
        gradient = [self.gradient[0] * inverse[0, m] + self.gradient[1] * inverse[1, m] for m in range(2)]
        ss, st, tt = self.hessian - gradient[0] * _aligned(plane[0], self) - gradient[1] * _aligned(plane[1], self)
        hessian = [
            ss * inverse[0, m] * inverse[0, n]
            + st * (inverse[0, m] * inverse[1, n] + inverse[1, m] * inverse[0, n])
            + tt * inverse[1, m] * inverse[1, n]
            for m, n in PAIRS
        ]
        return Jet(np.stack([self.value, *gradient, *hessian]))


def _aligned(scalar: Jet, vector: Jet) -> np.ndarray:
    """Second derivatives (3, ...) of a scalar jet, shaped to multiply those of a vector of jets."""
    h = scalar.hessian
    return h.reshape(3, *(1,) * (vector.data.ndim - h.ndim), *h.shape[1:])
