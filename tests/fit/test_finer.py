"""A coarse emulator put right by a fine solution at the device itself."""

import numpy as np

from bfsensor import Device
from bfsensor.fit.finer import Refiner
from bfsensor.fit.quantities import choose_priors
from bfsensor.recording.exposures import Condition
from bfsensor.response import solve_response
from tests.fit.linear_emulator import emulator_of_tangents, quadrant


def test_at_the_device_itself_the_fine_mesh_counts_and_elsewhere_the_coarse_slope():
    device = Device.load("e2v_ccd250_70")
    priors = choose_priors(device, ("channel.implant[0].dose",))
    at = Condition(gate_high=3.4)
    coarse = emulator_of_tangents(device, priors, condition=at)
    nominal = np.array([priors[0].mean])
    finer = Refiner(coarse, device, priors, (at,), cells=16)(nominal)
    there = device.with_value("gate_high", "3.4 V")
    wanted = quadrant(*solve_response(there, cells=16).edges(None, 173.0))
    found = finer.predict(nominal, at)
    np.testing.assert_allclose(found.areas, wanted, atol=1e-6 * np.abs(wanted).max())
    # The meshes differ by two thirds in y: 8 cells do not see this device.
    assert coarse.predict(nominal, at).areas[1, 0] > 1.4 * wanted[1, 0]
    moved = nominal + priors[0].spread
    change = finer.predict(moved, at).areas - found.areas
    expected = found.jacobian[0] * priors[0].spread
    np.testing.assert_allclose(change, expected, atol=1e-9 * np.abs(expected).max())
