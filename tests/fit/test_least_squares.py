"""Least squares against the posterior in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.device.quantities import Prior
from bfsensor.errors import FitError
from bfsensor.fit import least_squares
from bfsensor.fit.data import select
from bfsensor.fit.least_squares import LeastSquaresProblem, profile, solve
from bfsensor.fit.predictors import make_predictors
from tests.fit.toys import MEANS, PRIORS, SPREADS, toy_data, toy_emulator

TRUTH = np.array(MEANS) + np.array([0.8, -0.5, 1.2]) * SPREADS


def problem(*sets, priors=PRIORS, emulator=None):
    emulator = emulator or toy_emulator()
    return LeastSquaresProblem(priors, sets, make_predictors(sets, emulator, priors))


def closed_form(emulator, data, scale=1.0):
    """Mean and covariance of a linear model with Gaussian priors."""
    i, j = data.places.T
    response = emulator.predict(emulator.nominal, Condition())
    slope = response.jacobian[:, j, i].T
    weight = 1 / (scale * data.errors) ** 2
    covariance = np.linalg.inv(
        slope.T @ (weight[:, None] * slope) + np.diag(1 / np.array(SPREADS) ** 2)
    )
    step = slope.T @ (weight * (data.values - response.areas[j, i]))
    return np.array(MEANS) + covariance @ step, covariance


def test_linear_toy_has_the_posterior_of_the_closed_form():
    emulator = toy_emulator()
    data = toy_data(emulator, TRUTH, 12, scaled=False)
    found = solve(problem(data, emulator=emulator))
    values, covariance = closed_form(emulator, data)
    np.testing.assert_allclose(found.values, values, rtol=1e-7)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8)
    assert found.scales[0] == 1.0
    # The data do say something: the prior alone is not it.
    assert np.all(np.sqrt(np.diag(covariance)) < 0.9 * np.array(SPREADS))


@pytest.mark.parametrize("off", [0.25, 1.0, 4.0])
def test_misstated_errors_are_scaled_and_the_posterior_is_as_if_they_were_right(off):
    emulator = toy_emulator()
    honest = toy_data(emulator, TRUTH, 55)
    stated = replace(honest, errors=honest.errors / off)
    found = solve(problem(stated, emulator=emulator))
    # 24 lags and (0, 0), less three: a scale to 15 %.
    assert found.scales[0] == pytest.approx(off, rel=3 / np.sqrt(2 * 22))
    again = closed_form(emulator, stated, found.scales[0])
    np.testing.assert_allclose(found.values, again[0], rtol=1e-6)
    np.testing.assert_allclose(found.covariance, again[1], rtol=1e-6)
    # What defines it.
    dof = len(stated.values) - found.determined[0]
    assert found.chi2[0] / found.scales[0] ** 2 == pytest.approx(dof, rel=1e-3)


def test_few_numbers_have_no_scale():
    data = toy_data(toy_emulator(), TRUTH, 9)
    few = select(data, np.arange(len(data.values)) < 5, "few")
    assert solve(problem(few)).scales[0] == 1.0


def test_profile_of_a_linear_toy_is_its_parabola_and_minimises_the_others():
    data = toy_data(toy_emulator(), TRUTH, 12)
    whole = problem(data)
    found = solve(whole)
    values, rise = profile(whole, found, "silicon.background_doping")
    error = np.sqrt(found.covariance[1, 1])
    np.testing.assert_allclose(rise, ((values - found.values[1]) / error) ** 2, atol=1e-5)
    with pytest.raises(FitError, match=r"gates\.gate_oxide is not free; free are silicon"):
        profile(whole, found, "gates.gate_oxide")


def test_bounds_hold():
    data = toy_data(toy_emulator(), TRUTH, 12)
    unbound = solve(problem(data)).values[0]
    low = unbound + 0.2
    bound = (Prior("silicon.thickness", low + 1.0, 5.0, low=low), *PRIORS[1:])
    emulator = toy_emulator()
    pulled = replace(bound[0], mean=low)
    found = solve(problem(data, priors=(pulled, *PRIORS[1:]), emulator=emulator))
    assert found.values[0] == pytest.approx(low, abs=1e-3)


def test_what_is_not_fitted_has_no_say():
    emulator = toy_emulator()
    data = toy_data(emulator, TRUTH, 12)
    wild = replace(toy_data(emulator, TRUTH, 13, fitted=False), values=9 * data.values)
    alone, with_it = solve(problem(data)), solve(problem(data, wild))
    np.testing.assert_array_equal(alone.values, with_it.values)
    assert with_it.chi2[1] > 1000 and with_it.scales[1] == 1.0


def test_a_stated_voltage_is_not_free():
    emulator = toy_emulator()
    data = toy_data(emulator, TRUTH, 12, condition=Condition(back_bias=-50.0))
    found = solve(problem(data, emulator=emulator))
    assert found.values[2] == pytest.approx(MEANS[2], abs=1e-9)
    assert np.sqrt(found.covariance[2, 2]) == pytest.approx(SPREADS[2])
    free = solve(problem(toy_data(emulator, TRUTH, 12), emulator=emulator))
    assert np.sqrt(free.covariance[2, 2]) < 0.9 * SPREADS[2]


def test_refusals():
    data = toy_data(toy_emulator(), TRUTH, 12)
    with pytest.raises(FitError, match="no data to fit"):
        problem(replace(data, fitted=False))
    with pytest.raises(FitError, match="back_bias have no prior"):
        problem(data, priors=PRIORS[:2])
    with pytest.raises(FitError, match=r"spread of the prior 0\.0 must be above 0"):
        Prior("silicon.thickness", 100.0, 0.0)
    wide = replace(data, places=data.places + 6)
    with pytest.raises(FitError, match="lags beyond 4 are not predicted"):
        solve(problem(wide))
    saturation = replace(data, kind="saturation")
    with pytest.raises(FitError, match=r"toy: .*saturation"):
        problem(saturation)


def test_a_pair_stays_in_order_and_otherwise_does_not_matter():
    """Oxides: the gate's may be as thick as the field's, not thicker."""
    emulator = replace(
        toy_emulator(count=2), parameters=("gates.gate_oxide", "gates.field_oxide")
    )
    truth = np.array([MEANS[0] + 4.0, MEANS[1] - 0.4])
    data = toy_data(emulator, truth, 12, scaled=False)
    priors = (
        Prior("gates.gate_oxide", MEANS[0], SPREADS[0]),
        Prior("gates.field_oxide", MEANS[1], SPREADS[1]),
    )
    # The first is far above the second here: pulled together at whatever cost.
    tied = solve(problem(data, priors=priors, emulator=emulator))
    assert tied.values[0] == pytest.approx(tied.values[1], abs=1e-2)
    assert tied.values[0] <= tied.values[1]
    turned = replace(emulator, parameters=("gates.field_oxide", "gates.gate_oxide"))
    named = tuple(
        replace(p, name=n) for p, n in zip(priors, turned.parameters, strict=True)
    )
    free = solve(problem(data, priors=named, emulator=turned))
    assert free.values[0] == pytest.approx(truth[0], abs=4 * np.sqrt(free.covariance[0, 0]))


def test_a_fit_that_does_not_converge_gives_its_best_point(monkeypatch):
    data = toy_data(toy_emulator(), TRUTH, 12)
    whole = problem(replace(data, errors=data.errors / 4.0))
    settled = solve(whole)
    assert settled.converged
    monkeypatch.setattr(least_squares, "ROUNDS", 1)
    early = solve(whole)
    assert not early.converged and np.isfinite(early.values).all()
    # One round at the stated errors: their scale of about 4 is not found.
    assert early.scales[0] == 1.0 and settled.scales[0] > 2.0
    monkeypatch.undo()
    monkeypatch.setattr(least_squares, "MOST", 1)
    assert not solve(whole).converged
