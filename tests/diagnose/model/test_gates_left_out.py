"""Numbers of collecting gates are sought at the back biases at which such a device can be solved."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose.model.device_solver import PHASES, DeviceSolver
from bfsensor.diagnose.model.left_out_physics import _phases
from bfsensor.effects.changed_device import Moved
from bfsensor.effects.effect import Layout, Shot
from bfsensor.errors import DeviceError

BIASES = (-50.0, -35.0)


@pytest.fixture
def solver():
    return DeviceSolver(Device.load("itl_sta3800c").to_toml(), BIASES, (620.0,), True, True)


def refuse_at(monkeypatch, *refused):
    def moved(self, name, value, **_):
        assert name == PHASES and len(self.biases) == 1
        (bias,) = self.biases
        if bias in refused:
            raise DeviceError("not depleted")
        size = 1e-9 * abs(bias)
        return Moved((((620.0, bias), (np.full((3, 3), size), np.full((3, 3), size))),))

    monkeypatch.setattr(DeviceSolver, "moved", moved)


def change_at(kind, bias):
    shot, nothing = Shot("flat", 0, 1.0, 620.0, bias, 173.0), np.zeros((3, 3))
    return kind({PHASES: 1.0}).edges(nothing, nothing, shot, Layout((8, 8), ()))[0][1, 1]


def test_a_back_bias_without_a_solution_has_that_of_the_nearest(solver, monkeypatch):
    refuse_at(monkeypatch, -50.0)
    (kind,) = _phases(solver)
    assert (
        kind.variant == "fewer_gates"
        and "1 collecting gates, at -35 V alone" in kind.source
    )
    assert [change_at(kind, bias) for bias in BIASES] == pytest.approx([35e-9, 35e-9])


def test_each_back_bias_has_its_own_solution(solver, monkeypatch):
    refuse_at(monkeypatch)
    (kind,) = _phases(solver)
    assert kind.source.endswith("1 collecting gates")
    assert [change_at(kind, bias) for bias in BIASES] == pytest.approx([50e-9, 35e-9])


def test_a_device_that_is_refused_everywhere_is_no_candidate(solver, monkeypatch):
    refuse_at(monkeypatch, *BIASES)
    assert _phases(solver) == []
