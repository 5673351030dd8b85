from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from connrsfm_graph.synthetic.jet import Jet

FORMULAS: dict[str, Callable[[Jet, Jet], Jet]] = {
    "sum": lambda s, t: 2.0 - s + t * 3.0 - 1.5,
    "product": lambda s, t: s * t * t,
    "quotient": lambda s, t: (s + 1.0) / (t * t + 2.0),
    "power": lambda s, t: (s * s + t + 3.0) ** 0.5,
    "logarithm": lambda s, t: (s * t + 4.0).log(),
    "sine": lambda s, t: (s * 2.0 - t * t).sin(),
    "arc tangent": lambda s, t: (s * 2.0 - t * t).arctan(),
    "norm": lambda s, t: Jet.stack([s, t * s, t + 2.0]).squared_norm(),
    "rotation": lambda s, t: Jet.stack([s * s, t * s, t]).rotated(np.roll(np.eye(3), 1, axis=0))[0],
}


@pytest.mark.parametrize("name", FORMULAS)
def test_derivatives_agree_with_central_differences(name: str) -> None:
    s, t = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 9))
    h = 1e-4

    def at(ds: int, dt: int) -> Jet:
        return FORMULAS[name](*Jet.variables(s + ds * h, t + dt * h))

    jet = at(0, 0)
    values = {(i, j): at(i, j).value for i in (-1, 0, 1) for j in (-1, 0, 1)}
    gradient = [(values[1, 0] - values[-1, 0]) / (2 * h), (values[0, 1] - values[0, -1]) / (2 * h)]
    hessian = [
        (values[1, 0] - 2 * values[0, 0] + values[-1, 0]) / h**2,
        (values[1, 1] - values[1, -1] - values[-1, 1] + values[-1, -1]) / (4 * h**2),
        (values[0, 1] - 2 * values[0, 0] + values[0, -1]) / h**2,
    ]
    np.testing.assert_allclose(jet.gradient, gradient, atol=1e-6)
    np.testing.assert_allclose(jet.hessian, hessian, atol=1e-5)


def test_a_function_over_other_coordinates_is_recovered() -> None:
    """f(q) = (q1^2 q2, sin q2) written through q(s, t) and taken back over q has the derivatives of f."""
    s, t = Jet.variables(*np.random.default_rng(1).uniform(-1.0, 1.0, (2, 9)))
    plane = Jet.stack([s * 2.0 + t * t * 0.3, t + s.sin() * 0.5])

    def f(q1: Jet, q2: Jet) -> Jet:
        return Jet.stack([q1 * q1 * q2, q2.sin()])

    np.testing.assert_allclose(f(plane[0], plane[1]).over(plane).data, f(*Jet.variables(*plane.value)).data, atol=1e-13)


def test_coordinates_over_themselves_are_variables() -> None:
    s, t = Jet.variables(*np.random.default_rng(2).uniform(-1.0, 1.0, (2, 5)))
    plane = Jet.stack([s * 2.0 + t, t - s * s])
    jet = plane.over(plane).data
    np.testing.assert_allclose(jet[1:3], np.broadcast_to(np.eye(2)[..., None], (2, 2, 5)), atol=1e-14)
    np.testing.assert_allclose(jet[3:], 0.0, atol=1e-14)
