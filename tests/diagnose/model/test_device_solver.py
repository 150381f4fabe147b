"""Ranges of the quantities of a device that a diagnosis fits."""

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose import diagnosis
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


def test_a_field_oxide_is_at_least_as_thick_as_the_gate_oxide():
    """Fits of e2v's two equal oxides ended where no device is, and a null was an alarm (p 2e-5)."""
    own = solver("e2v_ccd250")
    oxides = "gates.gate_oxide", "gates.field_oxide"
    for given, wanted in (
        ((0.16, 0.15), (0.16, 0.16)), ((0.145, 0.14), (0.145, 0.145)),
        ((0.158, 0.145), (0.158, 0.158)), ((0.14, 0.16), (0.14, 0.16)),
        ((0.16, 0.17), (0.16, 0.17)),
    ):  # fmt: skip
        for order in (1, -1):
            values = dict(zip(oxides[::order], given[::order], strict=True))
            device = own.device_with(values, -50.0)
            assert (device.gates.gate_oxide, device.gates.field_oxide) == pytest.approx(
                wanted
            )
    assert own.device_with({oxides[0]: 0.17}, -50.0).gates.field_oxide == pytest.approx(
        0.17
    )
    # Its range ends at the gate oxide where the two are not one film.
    assert solver("itl_sta3800c").range(oxides[1])[0] == pytest.approx(0.1)


def test_a_field_oxide_that_is_fitted_thinner_than_the_gate_oxide_is_noted():
    def noted(gate, field):
        spread = {"gates.gate_oxide": 0.01, "gates.field_oxide": 0.01}
        baseline = SimpleNamespace(solver=solver("e2v_ccd250"), spread=spread)
        pulls = dict(zip(spread, (gate, field), strict=True))
        return diagnosis._as_one_film(baseline, SimpleNamespace(pulls=pulls))

    assert noted(-0.5, -0.5) == noted(0.0, 1.0) == []
    (note,) = noted(0.5, -0.5)
    assert "fitted as 0.145 um, thinner than the gate oxide of 0.155 um" in note
    nothing = SimpleNamespace(solver=None, spread={})
    assert diagnosis._as_one_film(nothing, SimpleNamespace(pulls={})) == []
