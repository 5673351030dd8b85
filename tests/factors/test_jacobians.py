"""Every factor of the package, in every set of active variables it offers, against central differences."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors.adapter import FactorError, make_factor
from factors.jacobian_check import examples, jacobian_error

EXAMPLES = list(examples(seed=1))


@pytest.mark.parametrize(("label", "factor", "values"), EXAMPLES, ids=[label for label, *_ in EXAMPLES])
def test_analytic_jacobian_agrees_with_central_differences(label, factor, values):
    assert jacobian_error(factor, values) < 1e-7, label


def test_every_set_of_active_variables_of_the_pair_factor_is_among_the_examples():
    active = {label.split("active ")[1] for label, *_ in EXAMPLES if label.startswith("conformal_pair: perspective")}
    assert len(active) == 2**4 - 1


def test_check_notices_a_wrong_jacobian():
    class Wrong:
        name = "wrong"
        rows = 1

        def residual(self, x):
            return x**2

        def jacobians(self, x):
            return x**2, [np.array([[x[0]]])]

    factor = make_factor(Wrong(), [5], [1], gtsam.noiseModel.Unit.Create(1))
    values = gtsam.Values()
    values.insert(5, np.array([1.5]))
    assert jacobian_error(factor, values) == pytest.approx(0.5, rel=1e-6)


class _Shaped:
    """A measurement of two variables that returns whatever shapes it is told."""

    name = "shaped"
    rows = 2

    def __init__(self, residual, blocks):
        self.answer = residual, blocks

    def residual(self, *x):
        return self.answer[0]

    def jacobians(self, *x):
        return self.answer


@pytest.mark.parametrize(
    ("residual", "blocks", "message"),
    [
        (np.zeros(3), [np.zeros((2, 1)), np.zeros((2, 2))], r"residual has shape \(3,\), expected \(2,\)"),
        (np.zeros(2), [np.zeros((2, 1))], "1 Jacobian blocks for 2 variables"),
        (np.zeros(2), [np.zeros((2, 1)), np.zeros((2, 1))], r"shape \(2, 1\), expected \(2, 2\)"),
        (np.zeros(2), [np.zeros((3, 1)), np.zeros((2, 2))], r"shape \(3, 1\), expected \(2, 1\)"),
        (np.zeros(2), [np.full((2, 1), np.nan), np.zeros((2, 2))], "is not finite"),
    ],
)
def test_adapter_refuses_what_would_crash_gtsam(residual, blocks, message):
    noise = gtsam.noiseModel.Unit.Create(2)
    with pytest.raises(FactorError, match=message):
        make_factor(_Shaped(residual, blocks), [1, 2], [1, 2], noise, example=(np.zeros(1), np.zeros(2)))


def test_adapter_names_noise_and_keys_that_do_not_fit():
    measurement = _Shaped(np.zeros(2), [])
    with pytest.raises(FactorError, match="noise model has dimension 3, expected 2"):
        make_factor(measurement, [1], [1], gtsam.noiseModel.Unit.Create(3))
    with pytest.raises(FactorError, match="named twice"):
        make_factor(measurement, [1, 1], [1, 1], gtsam.noiseModel.Unit.Create(2))
    with pytest.raises(FactorError, match="2 keys but 1 dimensions"):
        make_factor(measurement, [1, 2], [1], gtsam.noiseModel.Unit.Create(2))


def test_adapter_stops_residuals_that_are_not_numbers():
    from factors.keys import key

    factor = make_factor(_Shaped(np.array([np.nan, 0.0]), []), [key("b", 12, 3)], [1], gtsam.noiseModel.Unit.Create(2))
    values = gtsam.Values()
    values.insert(key("b", 12, 3), np.zeros(1))
    with pytest.raises(FactorError, match="log depth of point 12, view 3 is not finite"):
        factor.error(values)
