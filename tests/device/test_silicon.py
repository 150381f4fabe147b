"""The laws of silicon, held against plain arithmetic and independent tables."""

import math
from pathlib import Path

import galsim
import numpy as np
import pytest

from bfsensor.device.silicon import absorption_length, mobility
from bfsensor.errors import BFSensorError

GREEN = {350: 1.06e6, 400: 9.30e4, 600: 4175, 800: 850, 900: 303, 1000: 64.0, 1100: 3.5}
"""Green (2008), table 1: absorption coefficient [cm^-1] at 300 K by wavelength [nm]; read
from the refractiveindex.info database (as k) and from Genius-TCAD-Open (as alpha), which
agree within 0.5 %."""

FRANTA = {
    150.0: (1.259, 3.516, 8.729, 15.548, 58.296, 760.6),
    200.0: (1.111, 3.129, 7.823, 13.831, 45.596, 440.6),
    400.0: (0.619, 1.722, 4.394, 7.922, 16.498, 71.58),
}
"""Franta et al. (2017), Appl. Surf. Sci. 421, 405: absorption lengths [um] by temperature
[K] at 500, 600, ... 1000 nm; from k in the refractiveindex.info database (CC0)."""


def phonon_terms(wavelength, temperature):
    """Rajkanan et al. (1979), the indirect terms one by one [cm^-1]."""
    energy = 1239.841984 / wavelength
    kt = 8.617333262e-5 * temperature
    shrink = 7.021e-4 * temperature**2 / (temperature + 1108)
    total = 0.0
    for gap, strength in ((1.1557, 323.1), (2.5, 7237.0)):
        for phonon, coupling in ((0.01827, 5.5), (0.05773, 4.0)):
            above = energy - (gap - shrink)
            if above + phonon > 0:
                total += (
                    coupling * strength * (above + phonon) ** 2 / math.expm1(phonon / kt)
                )
            if above - phonon > 0:
                bose = 1 - math.exp(-phonon / kt)
                total += coupling * strength * (above - phonon) ** 2 / bose
    return total


@pytest.mark.parametrize("temperature", [77.0, 173.0, 300.0, 500.0])
@pytest.mark.parametrize("wavelength", GREEN)
def test_absorption_is_the_measured_one_times_the_ratio_of_phonon_terms(
    wavelength, temperature
):
    ratio = phonon_terms(wavelength, temperature) / phonon_terms(wavelength, 300.0)
    want = 1e4 / (GREEN[wavelength] * ratio)
    # Roundings of a few dozen operations, enlarged where energies nearly cancel (1100 nm).
    assert absorption_length(wavelength, temperature) == pytest.approx(want, rel=1e-11)


def test_absorption_between_measured_wavelengths_is_their_geometric_mean():
    ends = absorption_length([900.0, 910.0], 300.0)
    want = math.sqrt(ends[0] * ends[1])
    assert absorption_length(905.0, 300.0) == pytest.approx(want, rel=1e-12)


@pytest.mark.parametrize("temperature", [77.0, 173.0, 300.0, 400.0, 500.0])
def test_redder_light_goes_deeper(temperature):
    lengths = absorption_length(np.arange(350.0, 1051.0), temperature)
    assert np.all(np.diff(lengths) > 0)


def test_cold_silicon_is_more_transparent_at_every_wavelength():
    wavelengths = np.arange(250.0, 1451.0)
    by_temperature = [absorption_length(wavelengths, t) for t in np.arange(77.0, 501.0, 9)]
    assert np.all(np.diff(by_temperature, axis=0) < 0)


def test_absorption_agrees_with_the_table_of_galsim():
    """Schinke et al. (2015), 295 K: two assessments of the measurements, 5 % rms apart."""
    path = Path(galsim.meta_data.share_dir) / "sensors" / "abs_length.dat"
    table = np.loadtxt(path, skiprows=1)
    wavelengths, lengths = table[(table[:, 0] >= 350) & (table[:, 0] <= 1000)].T

    # Largest at 390 nm (13.3 %), where both sources list points 10 nm apart on a slope of
    # a factor 2; 11 % is the uncertainty that Schinke et al. give at 600 nm.
    ratio = absorption_length(wavelengths, 300.0) / lengths
    assert ratio.min() > 1 / 1.14 and ratio.max() < 1.14
    assert np.sqrt(np.mean(np.log(ratio) ** 2)) < 0.055
    # The temperature is that of the table, not of a cold camera.
    rms = {
        t: np.sqrt(np.mean(np.log(absorption_length(wavelengths, t) / lengths) ** 2))
        for t in np.arange(160.0, 401.0, 5.0)
    }
    assert min(rms, key=rms.get) == pytest.approx(295.0, abs=10.0)


@pytest.mark.parametrize("temperature", FRANTA)
def test_change_with_temperature_agrees_with_a_dispersion_model(temperature):
    """The model differs from measurements by up to 1.28 at 300 K already, hence 1.6."""
    wavelengths = np.arange(500.0, 1001.0, 100.0)
    ratio = absorption_length(wavelengths, temperature) / FRANTA[temperature]
    assert np.all((ratio > 1 / 1.6) & (ratio < 1.6))
    # Left at 300 K, the law would fail by far where depth matters.
    still = absorption_length(1000.0, 300.0) / FRANTA[temperature][-1]
    assert not 1 / 1.6 < still < 1.6


def test_ends_of_the_wavelengths():
    first, last = absorption_length([250.0, 1450.0], 173.0)
    assert np.array_equal(absorption_length([0.0, 100.0], 173.0), [first, first])
    assert np.isfinite(last)
    assert np.array_equal(absorption_length([1450.1, np.inf], 173.0), [np.inf, np.inf])
    assert absorption_length([], 173.0).shape == (0,)
    assert absorption_length(np.full((2, 3), 500.0), 173.0).shape == (2, 3)


@pytest.mark.parametrize("temperature", [77.0, 173.0, 300.0, 430.0])
@pytest.mark.parametrize("field", [0.0, 0.01, 0.5, 5.0])
def test_mobility_is_jacobonis(field, temperature):
    """The formula in its own units, V/cm and cm^2 / (V s)."""
    highest = 1.53e9 / temperature**0.87
    critical = 1.01 * temperature**1.55
    beta = 0.0257 * temperature**0.66
    bend = (1 + (1e4 * field / critical) ** beta) ** (1 / beta)
    want = highest / critical / bend
    assert mobility(field, temperature) / 1e8 == pytest.approx(want, rel=1e-12)


def test_velocity_saturates():
    """At v_m, for 300 K 1.53e9 / 300^0.87 = 1.071e7 cm/s."""
    fields = np.array([1.0, 10.0, 100.0, 1000.0])
    velocity = fields * mobility(fields, 300.0) * 1e-4  # cm/s
    assert np.all(np.diff(velocity) > 0)
    assert velocity[-1] == pytest.approx(1.071e7, rel=2e-3)


@pytest.mark.parametrize(
    ("law", "value", "temperature", "message"),
    [
        (absorption_length, np.nan, 173.0, "wavelength = nan nm must be a number from 0"),
        (absorption_length, [500.0, -1.0], 173.0, r"wavelength = -1\.0 nm must be"),
        (absorption_length, -np.inf, 173.0, "wavelength = -inf nm must be"),
        (absorption_length, 500.0, 76.9, r"temperature = 76\.9 K must be from 77 to 500 K"),
        (absorption_length, 500.0, 501.0, r"temperature = 501\.0 K must be from 77 to 500"),
        (absorption_length, 500.0, np.nan, "temperature = nan K must be from 77 to 500 K"),
        (mobility, np.nan, 173.0, "field = nan V/um must be a number from 0 V/um"),
        (mobility, [0.1, -0.5], 173.0, r"field = -0\.5 V/um must be"),
        (mobility, 0.5, 4.0, r"temperature = 4\.0 K must be from 77 to 500 K"),
    ],
)
def test_refusals(law, value, temperature, message):
    with pytest.raises(ValueError, match=message) as caught:
        law(value, temperature)
    assert isinstance(caught.value, BFSensorError)
