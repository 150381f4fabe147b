"""Ranges of the quantities of a device that a diagnosis fits."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose.model.device_solver import DeviceSolver
from bfsensor.errors import DeviceError


def solver(name):
    text = Device.load(name).to_toml()
    return DeviceSolver(text, (-50.0,), (620.0,), levels=True, depths=True)


def test_a_quantity_ends_where_no_device_can_be_built():
    """The taper and half of the channel stop, 0.9 um, are narrower than half of the pixel, 5 um."""
    own = solver("itl_sta3800c")
    low, high = own.range("gates.field_oxide_taper")
    assert low == 0.0 and high == pytest.approx(4.1, abs=1e-5)
    own.device_at("gates.field_oxide_taper", high, -50.0)
    with pytest.raises(DeviceError, match="field_oxide_taper"):
        own.device_at("gates.field_oxide_taper", high + 1e-4, -50.0)


def test_open_ends_and_limits_at_the_nominal_value_stay():
    assert np.isinf(solver("itl_sta3800c").range("channel.implant[0].dose")[1])
    # Both oxides of this device are 0.15 um thick, and the field oxide is not thinner.
    assert solver("e2v_ccd250").range("gates.gate_oxide")[1] == 5.0
