"""Flats taken at another setting of a lamp without a monitor are no physics of the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import median_filter

from bfsensor.diagnose.data.exposure_info import condition_of
from bfsensor.diagnose.data.lamp_settings import NEAREST, lamp_settings, smoothed_levels
from bfsensor.diagnose.data.measure_channels import measure_channels
from bfsensor.diagnose.diagnosis import diagnose_measured
from tests.virtual import SMALL, VirtualSource, virtual_baseline


def test_two_dimmer_settings_are_told_apart():
    rng = np.random.default_rng(3)
    seconds = np.array([5.0, 10, 20, 30, 40, 50, 90, 120, 200, 250])
    rate = np.array([1.0] * 6 + [1 / 3] * 2 + [0.1] * 2)
    levels = seconds * rate * (1 + 0.005 * rng.standard_normal(10))
    settings, light = lamp_settings(seconds, levels)
    assert len(set(settings[:6])) == len(set(settings[6:8])) == len(set(settings[8:])) == 1
    assert settings[0] == 0 and len(set(settings)) == 3
    assert light == pytest.approx(rate, rel=0.02)


def test_exposures_beyond_full_well_stay_with_their_dimmer_lamp():
    """Flats of an SBIG ST-7-type CCD: three of a bright lamp, and a ramp whose last ones are full.

    Means above the bias [ADU] of the frames of run 'langford' in Astr480/CCDChar @ ccdc2a3.
    """
    seconds = [6.0] * 3 + [
        5.0,
        15.0,
        25.0,
        35.0,
        45.0,
        55.0,
        65.0,
        75.0,
        85.0,
        90.0,
        95.0,
        105.0,
    ]
    levels = [17585.0, 17579.0, 17556.0, 1799.0, 6401.0, 11110.0, 15271.0, 19329.0, 23691.0, 27798.0,
              31122.0, 32996.0, 32429.0, 32341.0, 33963.0]  # fmt: skip
    settings, light = lamp_settings(seconds, levels)
    assert settings.tolist() == [0] * 3 + [1] * 12
    assert light[3:] == pytest.approx(430 / 2930, rel=0.05)


@pytest.mark.parametrize("response", ["full well", "blooming", "bent"])
def test_no_response_of_a_sensor_is_a_setting(response):
    seconds = np.linspace(1.0, 60.0, 12)
    charge = 3000.0 * seconds
    levels = {
        "full well": np.minimum(charge, 9e4),
        "blooming": np.where(charge > 9e4, 9e4 - 0.05 * (charge - 9e4), charge),
        "bent": charge * (1 - 0.3 * charge / 1.8e5),
    }[response]
    settings, light = lamp_settings(seconds, levels)
    assert not settings.any() and (light == 1).all()


@pytest.mark.slow
def test_a_lamp_at_a_third_is_no_alarm():
    source = VirtualSource(seed=7112, size=SMALL)
    flats = [e for e in source.exposures if e.kind == "flat"]
    longest = max(e.exposure_time for e in flats)
    flats = [e for e in flats if condition_of(e) == condition_of(flats[0])]
    # Headers of half of them state three times the time, as those of a lamp at a third would.
    dim = {e.number for e in flats[len(flats) // 2 :] if e.exposure_time > 0.4 * longest}
    source.exposures = [
        replace(e, lamp=None, exposure_time=e.exposure_time * (3 if e.number in dim else 1))
        if e.kind == "flat"
        else e
        for e in source.exposures
    ]
    measured = measure_channels(source)
    means = [c for c in measured.channels if c.word == "flat_mean"]
    assert any(c.axes["setting"].max() == 1 for c in means)
    assert not diagnose_measured(measured, virtual_baseline()).mismatch.detected


def test_levels_of_another_light_say_nothing_where_pixels_are_full():
    light = np.repeat([7.5, 25.0], 4)
    levels = np.repeat([2.5e5, 8.2e5], 4) * (1 + 1e-3 * np.tile([-1, 1, 2, -2], 2))
    found = smoothed_levels(levels, light, (), within=1.01)
    assert found == pytest.approx(np.repeat([2.5e5, 8.2e5], 4), rel=1.1e-3)
    # Compared with the other light, they are clearly off it and keep their own levels.
    found = smoothed_levels(levels, light, ())
    assert found == pytest.approx(np.repeat([2.5e5, 8.2e5], 4), rel=1.1e-3)


def test_levels_follow_a_response_that_bends():
    """The highest level of a ladder is that of its own flats, not what lower levels let expect."""
    light = np.repeat(np.linspace(5.0, 50.0, 8), 2)
    noise = 2e-4 * np.random.default_rng(8).standard_normal(light.size)
    bent = light * (1 - 0.15 * (light / 50) ** 2)
    found = smoothed_levels(bent * (1 + noise), light, ())
    np.testing.assert_allclose(found, bent, rtol=1e-3)


def test_levels_of_a_straight_response_are_those_of_many_exposures():
    light = np.repeat(np.linspace(5.0, 50.0, 8), 6)
    noise = 1e-3 * np.random.default_rng(9).standard_normal(light.size)
    found = smoothed_levels(light * (1 + noise), light, ()) / light
    ratio = median_filter(1 + noise, NEAREST, mode="mirror")
    np.testing.assert_allclose(found, ratio, rtol=1e-12)
