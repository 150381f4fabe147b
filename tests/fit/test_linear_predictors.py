"""Tangents of saturation and diffusion against full solutions and the closed form."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.depletion import find_depletion
from bfsensor.device.parts import ElectronTransport
from bfsensor.device.quantities import DIFFUSION, Prior, choose_priors
from bfsensor.errors import FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.device_at import device_at, fitted_device
from bfsensor.fit.linear_predictors import SPILL, START, make_tangents
from bfsensor.simulate.edge_field import front_plane
from bfsensor.simulate.full_depletion import full_depletion_voltage
from bfsensor.simulate.well import full_well
from bfsensor.units import VACUUM_PERMITTIVITY

DEVICE = Device.load("itl_sta3800c")


def data(kind, condition, value=1.0):
    return DataSet(
        "one", kind, np.array([value]), np.array([0.1]), (condition,),
        np.zeros((1, 2), np.int64),
    )  # fmt: skip


def test_full_wells_follow_the_parameters():
    names = (SPILL, "gates.gate_oxide", "gate_low:0.5 V")
    priors = choose_priors(DEVICE, names)
    stated = Condition(gate_high=1.0)
    predictor = make_tangents(DEVICE)["saturation"](data("saturation", stated), priors)
    middle = np.array([prior.mean for prior in priors])
    well, slopes = predictor(middle)
    there = replace(DEVICE, operating_point=replace(DEVICE.operating_point, gate_high=1.0))
    # full_well stops at 0.1 %.
    assert well[0] == pytest.approx(full_well(there, cells=8), rel=2e-3)
    for n, prior in enumerate(priors):
        moved = middle.copy()
        moved[n] += 0.7 * prior.spread
        changed = device_at(DEVICE, stated, priors, moved)
        full = full_well(changed, cells=8) - well[0]
        # Straight to a tenth, and the root is good to 0.2 % of the well.
        assert predictor(moved)[0][0] - well[0] == pytest.approx(
            full, rel=0.1, abs=2e-3 * well[0]
        )
        assert abs(slopes[0, n] * prior.spread) > 0.005 * well[0]


def test_diffusion_is_einsteins_in_a_nearly_even_field():
    priors = choose_priors(DEVICE, (DIFFUSION, "silicon.thickness", "back_bias:5 V"))
    at = Condition(back_bias=-60.0)
    predictor = make_tangents(DEVICE)["diffusion"](data("diffusion", at), priors)
    middle = np.array([prior.mean for prior in priors])
    width, slopes = predictor(middle)
    # A field that falls evenly with the doping: 2 kT/q times a logarithm.
    here = device_at(DEVICE, at)
    front = front_plane(here)
    length = 100.0 - front.height
    bend = 2.4 / (11.7 * VACUUM_PERMITTIVITY)
    mean = (front.potential + 60.0) / length
    high = mean + bend * (0.5 * length - (START - front.height))
    kt = DEVICE.material.thermal_voltage(173.0)
    expected = np.sqrt(2 * kt / bend * np.log(high / (mean - 0.5 * bend * length)))
    # Times the ratio that the device states, which is a free parameter here.
    assert middle[0] == DEVICE.transport.diffusion == 1.92
    assert width[0] == pytest.approx(1.92 * expected, rel=0.01)
    assert slopes[0, 0] == pytest.approx(width[0] / 1.92)
    # Width goes with the thickness; the stated voltage is not free.
    assert slopes[0, 1] == pytest.approx(width[0] / 98.0, rel=0.15)
    assert slopes[0, 2] == 0.0
    held = make_tangents(DEVICE)["diffusion"](data("diffusion", at), priors[1:])
    assert held(middle[1:])[0] == pytest.approx(width)


def test_the_full_depletion_voltage_follows_the_parameters():
    names = "silicon.background_doping", "silicon.thickness", "back_bias:5 V"
    priors = choose_priors(DEVICE, names)
    predictor = make_tangents(DEVICE)["depletion"](data("depletion", Condition()), priors)
    middle = np.array([prior.mean for prior in priors])
    voltage, slopes = predictor(middle)
    assert voltage[0] == pytest.approx(full_depletion_voltage(DEVICE, cells=8), abs=0.02)
    # Of an evenly doped slab: q N T^2 / 2 eps.
    drop = voltage[0] - find_depletion(DEVICE).front_potential
    assert slopes[0, 0] == pytest.approx(drop / middle[0], rel=0.1)
    assert slopes[0, 1] == pytest.approx(2 * drop / middle[1], rel=0.1)
    # The bias at which the sensor is operated does not matter.
    assert slopes[0, 2] == 0
    for n in (0, 1):
        moved = middle + 0.5 * priors[n].spread * (np.arange(3) == n)
        solved = full_depletion_voltage(
            device_at(DEVICE, Condition(), priors, moved), cells=8
        )
        assert predictor(moved)[0][0] - voltage[0] == pytest.approx(
            solved - voltage[0], rel=0.1
        )


def test_a_device_holds_its_fitted_width():
    priors = choose_priors(DEVICE, (DIFFUSION,))
    assert (priors[0].mean, priors[0].spread, priors[0].low) == (1.92, 0.2, 0.0)
    fitted = fitted_device(DEVICE, priors, np.array([1.6]), np.array([0.1]), "a test")
    assert fitted.transport.diffusion == 1.6
    assert Device.from_toml(fitted.to_toml()).provenance[DIFFUSION].uncertainty == 0.1
    bare = dataclasses.replace(
        DEVICE, transport=ElectronTransport(),
        provenance={k: v for k, v in DEVICE.provenance.items() if k != DIFFUSION},
    )  # fmt: skip
    unknown = choose_priors(bare, (DIFFUSION,))
    assert (unknown[0].mean, unknown[0].spread) == (1.0, 0.5)
    assert (
        fitted_device(bare, unknown, np.array([1.6]), np.array([0.1]), "a test").diffusion
        == 1.6
    )
    # All quantities with an uncertainty are free by 'all' but those that move no boundary.
    assert DIFFUSION not in {prior.name for prior in choose_priors(DEVICE, ("all",))}


def test_a_device_that_cannot_be_is_refused():
    priors = (Prior("gates.gate_oxide", 0.1, 0.01),)
    with pytest.raises(FitError, match=r"field_oxide"):
        device_at(DEVICE, Condition(), priors, np.array([2.0]))
