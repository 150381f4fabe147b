"""Raw exposures of a solved device hold its response, and direct spots the charge that they moved."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.fft

from bfsensor import Device
from bfsensor.direct.spot_exposure import Spot
from bfsensor.response.edge_response import CHARGE
from validation.concealed.plan import Geometry
from validation.silicon import recordings
from validation.silicon.counts import count, said

ITL = "itl_sta3800c"


def shifts_by(centre):
    """Shifts of the nearest edges alone, as a solved device has them in its array."""
    kx, ky = np.zeros((2, 9, 9))
    kx[4, 4], kx[4, 3] = centre, -centre
    ky[4, 4], ky[3, 4] = centre, -centre
    return kx, ky


def test_shifts_are_those_of_both_levels():
    low, high = shifts_by(-1.0e-6), shifts_by(-0.8e-6)
    response = recordings.linear_response(low, high, 32)
    for level, wanted in ((recordings.LOW, low), (recordings.HIGH, high)):
        charge = level + CHARGE / 2
        now = response.kx + (1 - 2 * charge / response.turning) * response.extra_kx
        found = scipy.fft.irfft2(now, s=(32, 32))
        assert found[0, 0] == pytest.approx(wanted[0][4, 4], rel=1e-5)
        assert found[0, -1] == pytest.approx(wanted[0][4, 3], rel=1e-5)


def test_only_the_first_back_bias_has_spots():
    taken = recordings.exposures("S", (-50.0, -35.0), 2)
    spots = [e for e in taken if e.kind == "SPOT"]
    assert len(spots) == 16 and {e.back_bias for e in spots} == {-50.0}
    flats = {(e.wavelength, e.back_bias) for e in taken if e.kind == "FLAT"}
    assert (620.0, -35.0) in flats and (950.0, -50.0) in flats


def spot():
    """Spot that moves a tenth of its central pixel, in two steps."""
    off = np.zeros((2, 5, 5), np.int32)
    off[0, 2, 2], off[1, 2, 2] = 1000, 2000
    off[:, 2, 1:4:2] = [[300], [600]]
    on = off.copy()
    on[0, 2, 2:4] += [-50, 50]
    on[1, 2, 2:4] += [-200, 200]
    return Spot(0, (2.0, 0.0), on, off, "key", 0.0)


def test_moved_charge_is_that_of_the_flux():
    here = spot()
    for flux, moved in ((0.0, 0.0), (800.0, 25.0), (1600.0, 50.0), (2400.0, 125.0)):
        found = recordings.moved_charge(here, flux)
        assert found[2, 2] == pytest.approx(-moved) and found.sum() == pytest.approx(0)
    with pytest.raises(ValueError, match="ends at 3200"):
        recordings.moved_charge(here, 3201.0)


def test_direct_spots_are_recorded_with_what_they_moved(monkeypatch):
    monkeypatch.setattr(recordings, "empty_widths", lambda *_: (1.0, 1.0))
    device = Device.load(ITL)
    still = dataclasses.replace(spot(), on=spot().off)
    exposure = next(
        e for e in recordings.exposures("T", (-50.0, -35.0), 1) if e.kind == "SPOT"
    )
    images = []
    for one in (spot(), still):
        sensor = recordings.DeviceSensor(
            Geometry(64), device, (-50.0, -35.0), seed=3, spots=(one,)
        )
        sensor.lamp = dataclasses.replace(sensor.lamp, spot_rate=3000.0 / exposure.seconds)
        images.append(np.hstack(sensor.take(exposure).frames).astype(float))
    # The gain is 1.4 or so; a spot of 3000 e- lost some 180 from its centre to one side.
    moved = images[0] - images[1]
    assert moved.min() < -60 and moved.max() > 60
    assert abs(moved.sum()) < 0.2 * np.abs(moved).sum()


def test_what_files_do_not_allow_is_drawn_again():
    device = Device.load(ITL)
    case = {"scatter": {}, "change": {"silicon.thickness": 1e4}}
    with pytest.raises(ValueError, match="beyond what device files allow"):
        recordings.device_of(device, case)


def test_counts_leave_out_what_cannot_be_seen():
    from astropy.table import Table

    rows = Table({
        "concealed": ["nothing", "memory", "echo", "memory"], "snr": [0.0, 9.0, 20.0, 2.0],
        "detected": [True, True, True, False], "in_class": [False, False, False, False],
        "first": [False, True, False, False], "outside": [False, False, True, False],
        "open_world": [False, True, True, False], "inside95": [0, 1, 0, 0],
        "intervals": [0, 1, 0, 0],
    })  # fmt: skip
    found = count(rows)
    assert found["alarms"] == (1, 1) and found["class"] == (1, 2)
    assert found["outside"] == (1, 1) and found["claimed"] == (1, 1)
    assert said((0, 15)) == "0 of 15 (0 to 20 %)"
