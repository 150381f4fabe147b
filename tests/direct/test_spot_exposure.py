"""The direct simulation of spots: electrons are kept, runs repeat, files read back."""

import dataclasses

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.direct import build_up
from bfsensor.direct import spot_exposure as exposure
from bfsensor.direct.spot_exposure import Spot, SpotPlan, simulate_spot
from bfsensor.direct.transport import Transport
from bfsensor.errors import DeviceError, SimulationError


def small(**changes):
    """A narrow spot on a small array, filled to half a well in three steps."""
    values = {
        "device": Device.load("itl_sta3800c"), "peak": 90_000.0, "sigma": 4.0, "steps": 3,
        "pixels": 5, "cells": 8, "seed": 88,
    }  # fmt: skip
    return SpotPlan(**{**values, **changes})


@pytest.fixture(scope="module")
def spot():
    return simulate_spot(small(), 2)


def test_all_electrons_are_collected(spot):
    plan = small()
    counts = np.round(np.linspace(0, plan.electrons, 4)).astype(int)[1:]
    assert np.array_equal(spot.on.sum((1, 2)), counts)
    assert np.array_equal(spot.off.sum((1, 2)), counts)
    assert (np.diff(spot.on, axis=0, prepend=0) >= 0).all()
    pitch = plan.device.pixel.pitch_x
    assert max(abs(c) for c in spot.centre) <= pitch / 2


def test_the_centre_loses_what_its_neighbours_gain(spot):
    """The table says how much: centre -11 % of its area per 1e5 e-, y neighbours most."""
    change = spot.on[-1] - spot.off[-1]
    brightest = np.unravel_index(spot.off[-1].argmax(), change.shape)
    lost = -change[brightest] / spot.off[-1][brightest]
    # Half the charge acts on average.
    charge = spot.off[-1][brightest]
    assert 0.3 < lost / (0.5 * 0.116 * charge / 1e5) < 1.2
    assert change.sum() == 0


@pytest.mark.slow
def test_the_same_plan_gives_the_same_bits(spot):
    again = simulate_spot(small(), 2)
    assert np.array_equal(again.on, spot.on) and np.array_equal(again.off, spot.off)
    assert again.centre == spot.centre and again.key == spot.key
    # The place of a spot depends on its number, not on how much falls there.
    few = {"peak": 3_000.0, "steps": 1}
    one, other = (simulate_spot(small(**few), number) for number in (2, 3))
    assert one.centre == spot.centre != other.centre


def test_without_feedback_both_images_are_equal(monkeypatch):
    """Common random numbers: what differs is the effect, not noise."""
    plan = small(peak=30_000.0)
    with_effect = simulate_spot(plan, 1)
    assert not np.array_equal(with_effect.on, with_effect.off)
    solve = build_up.Electrostatics.solve
    monkeypatch.setattr(
        build_up.Electrostatics, "solve", lambda self, charges, **k: solve(self, 0.0, **k)
    )
    without = simulate_spot(plan, 1)
    assert np.array_equal(without.on, without.off)
    assert np.array_equal(without.off, with_effect.off)


@pytest.mark.slow
def test_the_field_is_that_of_the_middle_of_the_step():
    """One step with the charge of its middle does what many steps do."""

    def moved(steps):
        spot = simulate_spot(small(steps=steps, transport=Transport(diffusion=0.0)), 5)
        return int(np.abs(spot.on[-1] - spot.off[-1]).sum())

    # The field of its beginning would do nothing in one step, that of its end twice as much.
    assert abs(moved(1) / moved(8) - 1) < 0.06


def test_files_read_back_equal(spot, tmp_path):
    path = tmp_path / "spot.fits"
    spot.write(path)
    again = Spot.read(path)
    assert np.array_equal(again.on, spot.on) and again.on.dtype == np.int32
    assert np.array_equal(again.off, spot.off)
    assert (again.number, again.centre, again.key) == (spot.number, spot.centre, spot.key)
    assert [p.name for p in tmp_path.iterdir()] == ["spot.fits"]
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(SimulationError, match="or damaged"):
        Spot.read(path)
    path.write_text("no FITS")
    with pytest.raises(SimulationError, match="not a spot"):
        Spot.read(path)


def test_heights_follow_the_absorption_length():
    plan = small(wavelength=900.0)
    starts = exposure._starts(plan, 77, np.arange(40_000), np.zeros(2))
    depth = plan.device.silicon.thickness - starts[:, 2]
    assert depth.min() >= 0 and depth.max() <= plan.device.silicon.thickness - 2.0
    # At 900 nm and 173 K: 66.8 um, truncated where the silicon ends.
    length, last = 66.77, plan.device.silicon.thickness - 2.0
    mean = length - last / np.expm1(last / length)
    assert abs(depth.mean() - mean) < 4 * depth.std() / np.sqrt(len(depth))
    assert abs(starts[:, 0].std() - plan.sigma) < 4 * plan.sigma / np.sqrt(2 * len(depth))


def test_plans_are_told_apart():
    keys = {
        small(**change).key
        for change in (
            {}, {"peak": 1e4}, {"sigma": 5.0}, {"steps": 4}, {"pixels": 7}, {"cells": 10},
            {"depth": 60.0}, {"wavelength": 620.0}, {"seed": 89},
            {"transport": Transport(diffusion=0.5)},
            {"device": Device.load("itl_sta3800c_60")},
        )
    }  # fmt: skip
    assert len(keys) == 11


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"peak": 0.0}, "peak = 0.0 must be from 1"),
        ({"sigma": -1.0}, "sigma = -1.0 must be"),
        ({"steps": 0}, "steps = 0 must be"),
        ({"pixels": 4}, "pixels = 4 must be odd"),
        ({"depth": 200.0}, "depth = 200.0 must be from 2 to 100"),
        ({"sigma": 9.0}, "sigma = 9 um is too wide for 5 pixels"),
        ({"depth": 50.0, "wavelength": 620.0}, "a depth or a wavelength, not both"),
    ],
)
def test_refuses_impossible_plans(change, message):
    with pytest.raises(DeviceError, match=message):
        small(**change)


def test_plans_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        small().peak = 3.0
