"""Predictions and their derivatives, for conditions that state a voltage and that do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.device.quantities import Prior
from bfsensor.errors import FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.least_squares import LeastSquaresProblem, solve
from bfsensor.fit.predictors import make_predictors
from bfsensor.fit.spot_response import slope_weights
from tests.fit.test_least_squares import TRUTH
from tests.fit.toys import MEANS, PRIORS, SPREADS, toy_data, toy_emulator

CONDITIONS = (Condition(), Condition(), Condition(back_bias=-50.0))


def slope_data(values=(1.0, 1.0, 1.0), sigma=1.1):
    return DataSet(
        "spots", "slopes", np.array(values), np.full(3, 0.05), CONDITIONS,
        np.array([[0, 0], [1, 0], [0, 0]]), sigma=sigma,
    )  # fmt: skip


def test_slopes_and_their_derivatives():
    emulator = toy_emulator()
    # One more parameter than the emulator has, in the middle.
    spill = Prior("well.spill_barrier", 2.2, 0.2)
    priors = (PRIORS[0], spill, *PRIORS[1:])
    (predictor,) = make_predictors([slope_data()], emulator, priors)
    values = np.insert(TRUTH, 1, 2.3)
    found, slopes = predictor(values)
    response = emulator.predict(TRUTH, None)
    x, y = slope_weights(1.1).slopes(response.kx, response.ky)
    held = emulator.predict(np.append(TRUTH[:2], MEANS[2]), None)
    np.testing.assert_allclose(
        found, [x, y, slope_weights(1.1).slopes(held.kx, held.ky)[0]], rtol=1e-12
    )
    for n, prior in enumerate(priors):
        step = 1e-3 * prior.spread * (np.arange(4) == n)
        change = (predictor(values + step)[0] - predictor(values - step)[0]) / (
            2e-3 * prior.spread
        )
        np.testing.assert_allclose(slopes[:, n], change, atol=1e-9)
    assert np.all(slopes[:, 1] == 0) and slopes[2, 3] == 0.0 and slopes[0, 3] != 0.0


def test_slopes_add_to_what_areas_tell():
    emulator = toy_emulator()
    areas = toy_data(emulator, TRUTH, 12, scaled=False)
    response = emulator.predict(TRUTH, None)
    both = slope_weights(1.1).slopes(response.kx, response.ky)
    held = emulator.predict(np.append(TRUTH[:2], MEANS[2]), None)
    third = slope_weights(1.1).slopes(held.kx, held.ky)[0]
    spots = slope_data((*both, third))
    spots = replace(spots, errors=np.full(3, 1e-3))
    covariances = []
    for sets in ((areas,), (areas, spots)):
        problem = LeastSquaresProblem(PRIORS, sets, make_predictors(sets, emulator, PRIORS))
        found = solve(problem)
        assert np.all(np.abs(found.values - TRUTH) < 4 * np.sqrt(np.diag(found.covariance)))
        covariances.append(found.covariance)
    # Three numbers more: the volume of the posterior shrinks.
    ratio = np.linalg.det(covariances[1]) / np.linalg.det(covariances[0])
    assert ratio < 0.1
    assert np.all(np.diag(covariances[1]) <= np.diag(covariances[0]) * (1 + 1e-9))
    assert np.all(np.sqrt(np.diag(covariances[1])) < SPREADS)


def test_what_needs_an_emulator_says_so():
    with pytest.raises(FitError, match="spots: slopes"):
        make_predictors([slope_data()], None, PRIORS)
