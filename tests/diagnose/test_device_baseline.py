"""A device whose parameters float: derivatives against tables at shifted values, kept and read."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose.baseline import area_matrix
from bfsensor.diagnose.conditions import Condition
from bfsensor.diagnose.device_baseline import (
    baseline_of_device,
    change_parameter,
    device_parameters,
)
from bfsensor.diagnose.sources import simulate_baseline
from bfsensor.errors import DiagnosisError

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


def test_implants_float_too():
    device = Device.load("itl_sta3800c")
    known = device_parameters(device)
    assert known["channel.implant[0].dose"] == 1000.0
    changed = change_parameter(device, "channel.implant[0].dose", 500.0)
    assert changed.channel.implants[0].dose == device.channel.implants[0].dose + 500.0
    assert changed.channel.implants[1] == device.channel.implants[1]


def test_what_cannot_float_is_named(tmp_path):
    device = Device.load("itl_sta3800c")
    with pytest.raises(DiagnosisError, match=r"states no uncertainty for .pixel\.pitch_x."):
        baseline_of_device(device, parameters=["pixel.pitch_x"])
    with pytest.raises(DiagnosisError, match=r"not for table\.fits"):
        simulate_baseline("table.fits", ["all"], [], keep=tmp_path)
    with pytest.raises(DiagnosisError, match="nowhere"):
        simulate_baseline("nowhere", ["all"], [], keep=tmp_path)
