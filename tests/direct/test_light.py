"""Light on the sensor: distributions against their closed forms."""

import numpy as np
import pytest
from scipy.stats import kstest

from bfsensor import Device
from bfsensor.device import silicon
from bfsensor.direct import light
from bfsensor.errors import SimulationError

DEVICE = Device.load("itl_sta3800c")
BOX = (-20.0, 30.0, 5.0, 25.0)
MANY = np.arange(20_000)


def test_spots_are_gaussian():
    places = light.spot(MANY, seed=41, centre=(3.0, -2.0), sigma=7.0)
    for axis, middle in ((0, 3.0), (1, -2.0)):
        assert kstest((places[:, axis] - middle) / 7.0, "norm").pvalue > 1e-3


def test_flats_are_even():
    places = light.flat(MANY, seed=42, box=BOX)
    assert kstest(places[:, 0], "uniform", (-20, 50)).pvalue > 1e-3
    assert kstest(places[:, 1], "uniform", (5, 20)).pvalue > 1e-3
    assert abs(np.corrcoef(places.T)[0, 1]) < 4 / np.sqrt(len(MANY))


@pytest.mark.parametrize("contrast", [0.3, 1.0])
def test_fringes_have_their_contrast(contrast):
    angle, period, phase = 0.4, 4.0, 0.7
    box = (0.0, 4000.0, 0.0, 3000.0)
    places = light.fringes(
        MANY, seed=43, box=box, period=period, angle=angle, contrast=contrast, phase=phase
    )
    s = places @ [np.cos(angle), np.sin(angle)]
    # The mean of cos over 1 + c cos is c / 2, of twice the angle 0.
    t = 2 * np.pi * s / period + phase
    error = np.sqrt(0.5 / len(t))
    assert abs(np.cos(t).mean() - contrast / 2) < 4 * error
    assert abs(np.sin(t).mean()) < 4 * error
    assert abs(np.cos(2 * t).mean()) < 4 * error


def test_no_contrast_is_a_flat():
    plain = light.flat(MANY, seed=44, box=BOX)
    fringed = light.fringes(MANY, seed=44, box=BOX, period=3.0, contrast=0.0)
    np.testing.assert_allclose(fringed, plain, atol=1e-12)


def test_beams_fill_their_cone():
    slopes = light.beam_slopes(MANY, seed=45, f_number=1.2, obscuration=0.6, index=3.9)
    t = np.hypot(*slopes.T)
    sine = t / np.sqrt(1 + t**2) * 3.9 * 2.4
    assert sine.max() < 1 and sine.min() > 0.6
    assert kstest(sine**2, "uniform", (0.36, 0.64)).pvalue > 1e-3
    assert np.abs(slopes.mean(0)).max() < 4 * slopes.std() / np.sqrt(len(slopes))


def test_conversion_follows_the_absorption_length():
    starts, converted = light.convert(
        DEVICE, np.zeros((len(MANY), 2)), seed=46, wavelengths=800.0
    )
    length = float(silicon.absorption_length(800.0, 173.0))
    depth = DEVICE.silicon.thickness - starts[:, 2]
    assert converted.mean() == pytest.approx(1 - np.exp(-98.0 / length), abs=0.005)
    assert kstest(depth[converted], lambda d: -np.expm1(-d / length)).pvalue > 1e-3


def test_slanted_photons_convert_along_their_way():
    places = np.zeros((len(MANY), 2))
    slope = np.array([0.5, -0.2])
    straight, _ = light.convert(DEVICE, places, seed=47, wavelengths=700.0)
    slanted, _ = light.convert(DEVICE, places, seed=47, wavelengths=700.0, slopes=slope)
    depth = DEVICE.silicon.thickness - np.array([straight[:, 2], slanted[:, 2]])
    np.testing.assert_allclose(depth[1], depth[0] / np.sqrt(1.29), rtol=1e-6)
    np.testing.assert_allclose(slanted[:, :2], slope * depth[1][:, None], atol=1e-9)


def test_photons_have_their_own_numbers():
    whole = light.spot(MANY[:100], seed=48, centre=(0, 0), sigma=1.0)
    part = light.spot(MANY[40:60], seed=48, centre=(0, 0), sigma=1.0)
    assert np.array_equal(whole[40:60], part)
    whole, part = (light.flat(n, seed=48, box=BOX) for n in (MANY[:100], MANY[40:60]))
    assert np.array_equal(whole[40:60], part)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: light.spot([0, 1], seed=1, centre=(0, 0), sigma=0.0), "sigma = 0.0 um"),
        (lambda: light.spot([0, 2], seed=1, centre=(0, 0), sigma=1.0), "consecutive"),
        (lambda: light.flat([0], seed=1, box=(1, 0, 0, 1)), "box = "),
        (lambda: light.fringes([0], seed=1, box=BOX, period=0), "period = 0 um"),
        (lambda: light.fringes([0], seed=1, box=BOX, period=1, contrast=2), "contrast = 2"),
        (lambda: light.beam_slopes([0], seed=1, f_number=0.4, index=4), "f_number = 0.4"),
        (lambda: light.beam_slopes([0], seed=1, f_number=1, index=0.5), "index = 0.5"),
        (lambda: light.convert(DEVICE, [[0, 0]], seed=1), "wavelengths or a height"),
        (lambda: light.convert(DEVICE, [[0, 0]], seed=1, height=300.0), "height = 300 um"),
        (lambda: light.convert(DEVICE, [[0, np.nan]], seed=1, height=50.0), "finite"),
    ],
)
def test_refuses_impossible_light(call, message):
    with pytest.raises(SimulationError, match=message):
        call()
