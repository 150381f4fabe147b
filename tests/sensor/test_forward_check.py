"""Corrected images through the sensor once more: the recorded ones come back."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, DistortionTable
from bfsensor.errors import BFSensorError
from bfsensor.sensor import forward_check
from bfsensor.sensor.forward_check import draw_again
from bfsensor.sensor.table_correction import correct_table

ITL = DistortionTable.load("itl_sta3800c")


def test_light_inside_pixels():
    y, x = np.indices((31 * 4, 33 * 4))
    fine = np.exp(-0.5 * ((y - 61) ** 2 + (x - 64) ** 2) / (4 * 1.1) ** 2)
    light = fine.reshape(31, 4, 33, 4).sum((1, 3))
    found = forward_check._light_inside(light)
    np.testing.assert_allclose(found.reshape(31, 4, 33, 4).sum((1, 3)), light, atol=1e-12)
    np.testing.assert_allclose(found, fine, atol=9e-3)
    assert np.abs(np.kron(light / 16, np.ones((4, 4))) - fine).max() > 0.1


def test_places_of_linear_light():
    u = (np.arange(100_000) + 0.5) / 100_000
    for slope in (-2.0, -0.7, 0.0, 1.3, 2.0):
        assert np.mean(forward_check._linear(u, np.full(len(u), slope))) == pytest.approx(
            0.5 + slope / 12, abs=1e-5
        )


def star_of(strength, seed):
    rng = np.random.default_rng([seed, 9])
    x, y = rng.normal(0, 1.1, (2, rng.poisson(9e4 * 2 * np.pi * 1.1**2)))
    photons = galsim.PhotonArray(len(x), x + 0.2, y - 0.1, np.ones(len(x)))
    image = galsim.ImageD(21, 21)
    image.setCenter(0, 0)
    sensor = BrighterFatterSensor(
        table=ITL, strength=strength, nrecalc=500, rng=galsim.BaseDeviate(seed)
    )
    sensor.accumulate(photons, image)
    return image.array


def spread(image):
    at = np.arange(len(image)) - len(image) // 2
    rows, columns = image.sum(1), image.sum(0)
    return np.array(
        [p @ at**2 / p.sum() - (p @ at / p.sum()) ** 2 for p in (columns, rows)]
    )


def test_recorded_stars_come_back():
    recorded = star_of(1.0, 12)
    corrected = correct_table(recorded, ITL, surroundings=0.0)
    again = draw_again(
        corrected, ITL, surroundings=0.0, repeats=4, rng=galsim.BaseDeviate(31)
    )
    change = np.abs(corrected - recorded)
    bright = change > 0.3 * change.max()
    assert change.max() > 1500 and bright.sum() >= 2
    # Half a per cent is what differs between the two roads; the rest are the photons' errors.
    left = again.image - recorded
    assert np.all(np.abs(left[bright]) < 4 * again.errors[bright] + 0.02 * change.max())
    grown = spread(recorded) - spread(corrected)
    assert np.all(grown > 0.01)
    assert np.all(np.abs(spread(again.image) - spread(recorded)) < 0.03 * grown)
    # A correction that is a tenth too small is seen.
    less = recorded + 0.9 * (corrected - recorded)
    other = draw_again(less, ITL, surroundings=0.0, repeats=2, rng=galsim.BaseDeviate(8))
    assert np.all(spread(other.image) - spread(recorded) > 0.06 * grown)


def test_repeats_give_the_same_and_colours_count():
    light = star_of(0.0, 4)
    first, second, red = (
        draw_again(light, ITL, rng=galsim.BaseDeviate(77), **more)
        for more in ({}, {}, {"wavelengths": [1000.0], "photons": [2.0]})
    )
    np.testing.assert_array_equal(first.image, second.image)
    moved = [np.abs(a.image - light).sum() for a in (first, red)]
    assert 0.8 < moved[1] / moved[0] < 0.97


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"corrected": np.ones(4)}, r"shape \(4,\), not two sides"),
        ({"corrected": np.full((4, 4), np.nan)}, "holds 16 values that are not finite"),
        ({"corrected": np.zeros((4, 4))}, "holds 0 e- above 0"),
        (
            {"corrected": np.full((40, 40), 1e6)},
            r"holds 1.6e\+09 e- .* at most 1e\+09 e-: cut",
        ),
        ({"repeats": 1}, "repeats = 1 must be a whole number from 2 on"),
    ],
)
def test_what_cannot_be_drawn_is_refused(given, message):
    given = {"corrected": np.ones((9, 9)), **given}
    with pytest.raises(BFSensorError, match=message):
        draw_again(table=ITL, **given)
