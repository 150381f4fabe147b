"""A device whose parameters float: derivatives against tables at shifted values, kept and read."""

import dataclasses

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose import device_baseline
from bfsensor.diagnose.baseline import area_matrix
from bfsensor.diagnose.conditions import Condition
from bfsensor.diagnose.device_baseline import (
    baseline_of_device,
    change_parameter,
    device_parameters,
)
from bfsensor.diagnose.sources import find_baseline, simulate_baseline
from bfsensor.errors import DeviceError, DiagnosisError

_replace = dataclasses.replace
HERE = Condition(620.0, -50.0, np.nan)


def test_a_changed_parameter_is_predicted(tmp_path):
    device = Device.load("itl_sta3800c")
    kept = simulate_baseline("itl_sta3800c", ["silicon.thickness"], [-60.0], keep=tmp_path)
    (path,) = tmp_path.glob("baseline_*.json")
    before = path.stat().st_mtime_ns
    again = simulate_baseline("itl_sta3800c", ["silicon.thickness"], [-60.0], keep=tmp_path)
    assert path.stat().st_mtime_ns == before
    for one, other in zip(kept.at(HERE)[0], again.at(HERE)[0], strict=True):
        np.testing.assert_array_equal(one, other)
    assert kept.spread == {"silicon.thickness": 5.0}
    thick = baseline_of_device(change_parameter(device, "silicon.thickness", 2.0))
    truth = area_matrix(*thick.at(HERE)[0])
    predicted = area_matrix(*kept.at(HERE, {"silicon.thickness": 2.0})[0])
    plain = area_matrix(*kept.at(HERE)[0])
    n = len(plain) // 2
    moved = truth[n, n] - plain[n, n]
    assert abs(moved) > 0.003 * abs(plain[n, n])
    assert predicted[n, n] - plain[n, n] == pytest.approx(moved, rel=0.1)
    assert kept.at(Condition(620.0, -60.0, np.nan))[1]


def test_as_accurate_as_the_shipped_table():
    """Within 3 % at the nearest lags: half as many cells a pixel are 10 % off at (1, 0)."""
    made = baseline_of_device(Device.load("e2v_ccd250_70")).areas_on(HERE, None, 40_000.0)
    shipped = find_baseline("e2v_ccd250_70").areas_on(HERE, None, 40_000.0)
    n = len(made) // 2
    near = np.s_[n : n + 2, n : n + 2]
    np.testing.assert_allclose(made[near], shipped[near], rtol=0.03)


def test_implants_float_too():
    device = Device.load("itl_sta3800c")
    known = device_parameters(device)
    assert known["channel.implant[0].dose"] == 1000.0
    changed = change_parameter(device, "channel.implant[0].dose", 500.0)
    assert changed.channel.implants[0].dose == device.channel.implants[0].dose + 500.0
    assert changed.channel.implants[1] == device.channel.implants[1]


@pytest.mark.parametrize(
    "name", ["itl_sta3800c", "itl_sta3800c_60", "e2v_ccd250", "e2v_ccd250_70"]
)
def test_every_uncertain_quantity_can_be_changed(name):
    """Of dots and implants in stops too; to one side at least, as oxides of equal thickness."""
    device = Device.load(name)
    for key, spread in device_parameters(device).items():
        changed, refused = [], 0
        for sign in (1.0, -1.0):
            try:
                changed.append(change_parameter(device, key, sign * 0.5 * spread).to_toml())
            except DeviceError:
                refused += 1
        assert refused < 2 and device.to_toml() not in changed, key
        assert refused == 0 or key in ("gates.gate_oxide", "gates.field_oxide")


@pytest.mark.parametrize(
    "key",
    ["gates", "gates.", "gates.thing", "silicon.implant[0].dose", "channel.implant[9].dose",
     "channel.implant[0]", "channel.implants", "gates.gate_oxide.more"],
)  # fmt: skip
def test_what_a_device_does_not_have(key):
    with pytest.raises(DiagnosisError, match="no quantity"):
        change_parameter(Device.load("itl_sta3800c"), key, 1.0)


def test_a_quantity_at_the_end_of_what_can_be(monkeypatch):
    """Derivatives from the one side on which there is a device; here of a known slope."""

    def edges(table, wavelength, temperature, *, background):
        nothing = np.zeros((11, 11))
        return nothing + 3.0 * table.gates.gate_oxide - table.gates.field_oxide, nothing

    monkeypatch.setattr(device_baseline, "plan_table", lambda device, **options: device)
    monkeypatch.setattr(device_baseline.dataclasses, "replace", replace_but_plans)
    monkeypatch.setattr(device_baseline, "build_table", lambda plan: plan)
    monkeypatch.setattr(device_baseline, "edges_at", edges)
    found = baseline_of_device(
        Device.load("e2v_ccd250"), parameters=["gates.gate_oxide", "gates.field_oxide"]
    )
    np.testing.assert_allclose(found.derivatives["gates.gate_oxide"][0], 3.0)
    np.testing.assert_allclose(found.derivatives["gates.field_oxide"][0], -1.0)


def replace_but_plans(part, **changes):
    """``dataclasses.replace``, which here meets devices in the place of plans of tables."""
    return part if "cells" in changes else _replace(part, **changes)


def test_what_cannot_float_is_named(tmp_path):
    device = Device.load("itl_sta3800c")
    with pytest.raises(DiagnosisError, match=r"states no uncertainty for .pixel\.pitch_x."):
        baseline_of_device(device, parameters=["pixel.pitch_x"])
    with pytest.raises(DiagnosisError, match=r"not for table\.fits"):
        simulate_baseline("table.fits", ["all"], [], keep=tmp_path)
    with pytest.raises(DiagnosisError, match="nowhere"):
        simulate_baseline("nowhere", ["all"], [], keep=tmp_path)
