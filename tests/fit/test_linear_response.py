"""Tangents about a device against solutions of its neighbours."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.quantities import choose_priors
from bfsensor.errors import FitError
from bfsensor.fit.linear_response import Linearise


@pytest.mark.slow
def test_tangents_lead_to_neighbours_except_by_what_is_stated():
    device = Device.load("itl_sta3800c_60")
    priors = choose_priors(device, ("gate_oxide", "gate_high:0.5 V", "back_bias:5 V"))
    stated = Condition(gate_high=2.9, wavelength=620.0)
    linearise = Linearise(device, priors, (Condition(), stated), cells=8)
    means = np.array([prior.mean for prior in priors])
    step = np.array([-0.02, 0.02, 0.02]) * [prior.spread for prior in priors]
    here, there = linearise(means), linearise(means + step)
    for condition in (Condition(), stated):
        told = here.predict(means + step, condition)
        wanted = there.predict(means + step, condition)
        change = wanted.areas - here.predict(means, condition).areas
        # A fiftieth of a spread: the quadratic change is a few hundredths of the linear one.
        np.testing.assert_allclose(
            told.areas, wanted.areas, atol=0.03 * np.abs(change).max()
        )
    assert np.all(here.predict(means, stated).jacobian[1] == 0)
    assert np.any(here.predict(means, Condition()).jacobian[1] != 0)
    moved = means + np.array([0.0, 5.0, 0.0])
    np.testing.assert_array_equal(
        here.predict(moved, stated).areas, here.predict(means, stated).areas
    )
    with pytest.raises(FitError, match="no response was solved at 900 nm"):
        here.predict(means, Condition(wavelength=900.0))
