"""Edges of a sensor as a fixed map: areas, photons, sides, refusals."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, ShiftMap, SiliconSensor
from bfsensor.errors import SensorError

NX, NY = 30, 20
FALL = np.exp(-np.arange(41) / 2.5)
SIDES = {"x_low": (1, 0), "x_high": (1, -1), "y_low": (0, 0), "y_high": (0, -1)}


def sensor(shift_map):
    return BrighterFatterSensor(
        "itl_sta3800c", strength=0.0, diffusion_factor=0.0, depth=False, shift_map=shift_map,
        rng=galsim.BaseDeviate(3207),
    )  # fmt: skip


def light(x, y):
    photons = galsim.PhotonArray(len(x), np.array(x, float), np.array(y, float))
    photons.flux = 1.0
    return photons


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("size", [1.7, -6.0])
def test_areas_and_light_follow_the_boundaries(side, size):
    """Pixels that lose light and pixels that are several times too large."""
    shifts = size * FALL
    shifts = np.maximum.accumulate(shifts + np.arange(41)) - np.arange(41)
    instrument = sensor(ShiftMap.from_edges((NY, NX), **{side: shifts}))
    axis, end = SIDES[side]
    pixels = NX if axis else NY
    image = galsim.ImageD(NX, NY)
    areas = instrument.calculate_pixel_areas(image).array
    expected = 1.0 + np.diff(shifts)[:pixels]
    along = areas.mean(axis=1 - axis)
    # Positions along a side are in single precision.
    assert along[:: 1 if end == 0 else -1] == pytest.approx(expected, abs=3e-7)
    assert np.ptp(areas, axis=1 - axis).max() < 1e-9

    # Even light, from well outside the sensor: whole rows of points.
    step = 1 / 64
    places = np.arange(-9, pixels + 9, step) + 0.5 * step + 0.5
    across = np.full(len(places), 7.0)
    x, y = (places, across) if axis else (across, places)
    instrument.accumulate(light(x, y), image)
    counts = image.array.sum(axis=1 - axis)[:: 1 if end == 0 else -1] * step
    # Points are counted: one more or less at either boundary.
    assert counts == pytest.approx(expected, abs=2.1 * step)


@pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])
def test_light_lands_by_the_areas_that_the_charge_of_a_star_leaves(kind):
    """Pixels collect even light by their areas; GalSim's sensor misses those of this table by 0.0017."""
    star = galsim.Gaussian(flux=1e6, sigma=0.3).drawImage(
        nx=17, ny=17, scale=0.3, dtype=float
    )
    star.setCenter(0, 0)
    # A sequence that fills the square more evenly than random numbers (Roberts 2018), and light of
    # which every electron is exact beside 1e5 e-, and all of it too little to move a boundary.
    n, ratio, flux = 1_000_000, 1.32471795724474602596, 2.0**-20
    index = np.arange(n)
    rays = light(5 * (index / ratio % 1) - 2.5, 5 * (index / ratio**2 % 1) - 2.5)
    rays.flux = flux
    instrument = kind(diffusion_factor=0.0, nrecalc=0, rng=galsim.BaseDeviate(3209))
    image = star.copy()
    instrument.accumulate(rays, image)
    middle = np.s_[7:10, 7:10]
    counts = (image.array - star.array)[middle] * 25 / (n * flux)
    areas = instrument.calculate_pixel_areas(star).array[middle]
    assert 1 - areas.min() > 0.08
    # Counts of a 25th of the points at a boundary of even rays: 3e-4 with as many, 8e-4 with a
    # quarter.  The areas of BrighterFatterSensor hold at the back surface, 1 um above this light.
    assert counts == pytest.approx(areas, abs=8e-4)


def test_sides_add_up():
    both = ShiftMap.from_edges((NY, NX), x_low=FALL, x_high=-FALL, y_low=0.5 * FALL)
    pad = round(0.5 - both.x0)
    inside = both.dx[pad:-pad, pad:-pad]
    assert inside.shape == (NY + 1, NX + 1)
    low = FALL[: NX + 1]
    assert inside == pytest.approx(np.tile(low + low[::-1], (NY + 1, 1)))
    assert both.dy[pad:-pad, 3] == pytest.approx(0.5 * FALL[: NY + 1])
    assert both.dx[0] == pytest.approx(both.dx[-1])
    assert (both.depth, both.y0) == ("bulk", both.x0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x_low": [0.1]}, "x_low must hold the finite shifts of at least two"),
        ({"y_low": [0.1, np.nan]}, r"y_low .* with nan"),
        ({"x_high": [[0.1, 0.2]]}, r"x_high .* shape \(1, 2\)"),
        ({"y_high": [2.0, 0.5, 0.0]}, "y_high: the shifts make boundaries cross"),
        ({"x_low": [0.5, 0.3]}, "x_low ends 1 pixels from the edge at 0.3 pixel"),
        ({"x_low": 8.0 * np.exp(-np.arange(31) / 9), "x_high": 8.0 * np.exp(-np.arange(31) / 9),
          "shape": (5, 4)}, "opposite edges make boundaries cross"),
        ({"shape": (0, 5)}, r"shape = \(0, 5\)"),
    ],
)  # fmt: skip
def test_refusals(options, message):
    shape = options.pop("shape", (NY, NX))
    with pytest.raises(SensorError, match=message):
        ShiftMap.from_edges(shape, **options)
