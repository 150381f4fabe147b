"""Tangents about a device against solutions of its neighbours."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.quantities import choose_priors
from bfsensor.errors import FitError
from bfsensor.fit import full_solutions, linear_response
from bfsensor.fit.full_solutions import solve_shifts
from bfsensor.fit.linear_response import Linearise
from bfsensor.response.edge_response import area_matrix, solve_response
from bfsensor.simulate.boundaries import BISECTION


def test_a_response_is_taken_at_the_level_of_its_recording(monkeypatch):
    """The centre of an empty ITL sensor loses more than that of one filled half."""
    device = Device.load("itl_sta3800c")
    coarse = {"cells": 8, "refine_z": 0, "precision": BISECTION}
    monkeypatch.setattr(
        linear_response, "solve_response",
        lambda device, *, level, cells, changed, laid_for: solve_response(
            device, level=level, changed=changed, laid_for=laid_for, **coarse
        ),
    )  # fmt: skip
    levels = Condition(), Condition(level=0.0), Condition(level=80_000.0)
    none = np.zeros(0)
    found = Linearise(device, (), levels, cells=8)(none)
    usual, empty, full = (found.predict(none, c).areas[0, 0] for c in levels)
    assert empty < 1.01 * usual < 1.02 * full < 0
    alone = area_matrix(*solve_response(device, level=0.0, **coarse).edges(None, 173.0))
    middle = len(alone) // 2
    assert empty == pytest.approx(alone[middle, middle], rel=1e-12)
    monkeypatch.setattr(
        full_solutions, "solve_nodes",
        lambda nodes, **options: (
            asked.extend(node.level for node in nodes) or {}
        ),
    )  # fmt: skip
    asked: list[float] = []
    with pytest.raises(KeyError):  # nothing is solved here
        solve_shifts(device, (), none, levels, cells=8, refine_z=0)
    assert asked == [40_000.0, 0.0, 80_000.0]


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
