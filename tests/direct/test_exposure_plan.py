"""Common parts of spots and flats: keys that stay, the full well, files."""

import dataclasses

import numpy as np
import pytest
from astropy.io import fits

from bfsensor import Device
from bfsensor.device.parts import ElectronTransport, Ripple
from bfsensor.direct import exposure_plan as exposure_base
from bfsensor.direct.exposure_plan import step_ends
from bfsensor.direct.flat_exposure import Flat, FlatPlan, simulate_flat
from bfsensor.direct.spot_exposure import Spot, SpotPlan, simulate_spot
from bfsensor.direct.transport import Transport
from bfsensor.errors import DeviceError, SimulationError
from bfsensor.simulate.well import full_well

ITL = Device.load("itl_sta3800c")


def fewer(kind, **changes):
    """A plan of a second or less."""
    values = {"device": ITL, "steps": 1, "pixels": 3}
    if kind is SpotPlan:
        values |= {"sigma": 3.0, "peak": 2000.0}
    else:
        values |= {"level": 200.0}
    return kind(**{**values, **changes})


def without_width(device):
    """The device as its file was before it stated the width of the diffusion."""
    known = {k: v for k, v in device.provenance.items() if k != "transport.diffusion"}
    return dataclasses.replace(device, transport=ElectronTransport(), provenance=known)


BOTH = pytest.mark.parametrize(
    ("kind", "charge", "simulate"),
    [(SpotPlan, "peak", simulate_spot), (FlatPlan, "level", simulate_flat)],
)


def test_keys_are_those_of_files_that_exist():
    """As the first version computed them; a file is found by its key."""
    device = ITL.with_operating_point(back_bias="-60 V", gate_high="4 V", gate_low="-8 V")
    einstein = {"transport": Transport(diffusion=1.0)}
    spots = SpotPlan(without_width(device), steps=40, **einstein)
    assert spots.key == "f537ac8dfdee7cca"
    flats = FlatPlan(without_width(Device.load("e2v_ccd250")), **einstein)
    assert flats.key == "8fec91f2750a5049"
    # With the width that the device states results are others, and so is the key.
    assert SpotPlan(device, steps=40).key != spots.key


@BOTH
def test_more_than_the_full_well_is_refused_in_python_too(kind, charge, simulate):
    plan = fewer(kind, **{charge: 160_000.0})
    message = (
        rf"{plan.KIND}: {charge} = 160000 e- must be below the full well of itl_sta3800c, "
        r"151\d\d\d e-: electrons that spill are not followed"
    )
    with pytest.raises(SimulationError, match=message):
        simulate(plan, 0)
    # With finer cells the well of the same device is deeper.
    dataclasses.replace(plan, cells=16).check_full_well()


def test_the_full_well_is_solved_once_for_all_spots(monkeypatch):
    solved = []

    def count(device, *, cells):
        solved.append((device.name, cells))
        return full_well(device, cells=cells)

    monkeypatch.setattr(exposure_base, "full_well", count)
    exposure_base._full_well.cache_clear()
    plan = fewer(SpotPlan)
    for number in range(3):
        simulate_spot(plan, number)
    simulate_flat(fewer(FlatPlan), 0)
    assert solved == [("itl_sta3800c", 8)]
    fewer(FlatPlan, device=Device.load("e2v_ccd250")).check_full_well()
    assert len(solved) == 2


def test_the_full_well_of_a_device_without_mirror_planes():
    """Ripples of nothing are nothing: 0.1 % is what either is solved to."""
    silicon = dataclasses.replace(ITL.silicon, ripples=(Ripple("plane", 1e-9, 30.0),))
    rippled = dataclasses.replace(ITL, silicon=silicon)
    assert not rippled.is_mirror_symmetric
    assert full_well(rippled, cells=8) == pytest.approx(full_well(ITL, cells=8), rel=2e-3)
    with pytest.raises(SimulationError, match="below the full well"):
        fewer(SpotPlan, device=rippled, peak=160_000.0).check_full_well()


@BOTH
@pytest.mark.parametrize("name", ["steps", "pixels", "cells", "seed"])
def test_counts_are_whole(kind, charge, simulate, name):
    with pytest.raises(DeviceError, match=rf"{name} = 9.5 must be a whole number"):
        fewer(kind, **{name: 9.5})
    with pytest.raises(DeviceError, match=rf"{name} = nan must be from"):
        fewer(kind, **{name: np.nan})
    with pytest.raises(DeviceError, match=rf"{charge} = nan must be from"):
        fewer(kind, **{charge: np.nan})


def test_equal_steps():
    assert step_ends(10, 4).tolist() == [0, 2, 5, 8, 10]


# -- files -----------------------------------------------------------------------------


def test_flats_read_back_equal(tmp_path):
    plan = fewer(FlatPlan, transport=Transport(diffusion=0.0))
    flat = simulate_flat(plan, 4)
    assert flat.key == plan.key
    path = tmp_path / "flat.fits"
    flat.write(path)
    again = Flat.read(path)
    np.testing.assert_array_equal(again.on, flat.on)
    np.testing.assert_array_equal(again.off, flat.off)
    assert (again.number, again.key) == (4, plan.key) and again.on.dtype == np.int32
    with pytest.raises(SimulationError, match=r"flat\.fits: not a spot of the direct"):
        Spot.read(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(SimulationError, match=r"not a flat of the direct.*, or damaged"):
        Flat.read(path)


def spoil(path, change):
    with fits.open(path, memmap=False) as hdus:
        change(hdus)
        hdus.writeto(path, overwrite=True, checksum=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h[0].header.remove("CENTRE_X"), "not a spot .* or damaged"),
        (lambda h: h.pop("OFF"), "not a spot .* or damaged"),
        (lambda h: h[0].header.set("SPOT", "two"), "not a spot .* or damaged"),
        (lambda h: setattr(h["ON"], "data", None), "not a spot .* or damaged"),
        (
            lambda h: setattr(h["ON"], "data", h["ON"].data[:1]),
            r"images \(1, 3, 3\) and \(2, 3, 3\) are not",
        ),
    ],
)
def test_what_a_file_lacks_is_one_error(tmp_path, change, message):
    images = np.arange(18, dtype=np.int32).reshape(2, 3, 3)
    path = tmp_path / "spot.fits"
    Spot(1, (0.5, -2.0), images, images, "abc", 3.0).write(path)
    assert Spot.read(path).centre == (0.5, -2.0)
    spoil(path, change)
    with pytest.raises(SimulationError, match=rf"spot\.fits: .*{message}"):
        Spot.read(path)


def test_a_disk_that_is_full_is_one_error(tmp_path):
    images = np.zeros((1, 3, 3), np.int32)
    with pytest.raises(SimulationError, match=r"absent/flat\.fits: cannot be written"):
        Flat(0, images, images, 1.0).write(tmp_path / "absent" / "flat.fits")
