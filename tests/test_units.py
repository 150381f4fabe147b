"""Units: numbers known by hand, exact round trips, and refusals by message."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor.device.written_units import INTERNAL, from_internal, to_internal
from bfsensor.errors import DeviceError
from bfsensor.units import BOLTZMANN, VACUUM_PERMITTIVITY, to_celsius, to_kelvin

WRITTEN = {
    "length": "um",
    "potential": "V",
    "temperature": "K",
    "angle": "deg",
    "field": "V / cm",
    "density": "cm-3",
    "dose": "cm-2",
    "number": "",
}
"""The unit in which a device file holds each kind."""


def test_every_kind_is_tried():
    assert set(WRITTEN) == set(INTERNAL)


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("100 um", "length", 100.0),
        ("0.1 mm", "length", 100.0),
        ("50 nm", "length", 0.05),
        ("-50 V", "potential", -50.0),
        ("20 mV", "potential", 0.02),
        ("173 K", "temperature", 173.0),
        ("180 deg", "angle", math.pi),
        ("1e12 cm-2", "dose", 1e4),  # 1 cm = 1e4 um
        ("-2.4e12 cm-3", "density", -2.4),
        ("2 / cm2", "dose", 2e-8),
        ("3.9", "number", 3.9),
        ("7 %", "number", 0.07),
    ],
)
def test_conversions(text, kind, value):
    # Two roundings: parsing and one factor.
    assert to_internal(text, kind) == pytest.approx(value, rel=4e-16, abs=0)


@pytest.mark.parametrize("kind", WRITTEN)
@settings(deadline=None)
@given(value=st.floats(-1e12, 1e12))
def test_what_is_written_reads_as_the_same_float(kind, value):
    assert to_internal(from_internal(value, kind, WRITTEN[kind]), kind) == value


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (10.0, "length", "10 um"),
        (-50.0, "potential", "-50 V"),
        (0.1, "length", "0.1 um"),
        (1e4, "dose", "1e+12 cm-2"),
        (math.pi / 2, "angle", "90 deg"),
        (11.7, "number", "11.7"),
        (1 / 3, "number", "0.3333333333333333"),
    ],
)
def test_written_for_people(value, kind, text):
    assert from_internal(value, kind, WRITTEN[kind]) == text


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        (
            "100",
            "length",
            "'100' has no unit; expected one of length, such as um",
        ),
        ("100 V", "length", "'100 V' is not a length; expected a unit such as um"),
        ("1 cm-3", "dose", "'1 cm-3' is not a dose; expected a unit such as um-2"),
        ("1 um", "number", "'1 um' is not a number; expected no unit"),
        (
            "20 deg_C",
            "temperature",
            "'20 deg_C' is not a temperature; expected a unit such as K",
        ),
        *(
            (text, "length", f"{text!r} is not a number with a unit, such as '100 um'")
            for text in ("", "um", "a lot", "5 smoots", "[1, 2] um", "1 um; 2 um")
        ),
    ],
)
def test_refusals(text, kind, message):
    with pytest.raises(DeviceError) as caught:
        to_internal(text, kind)
    assert str(caught.value) == message


@given(st.integers(-27_315, 10_000))
def test_temperatures_come_back_from_celsius_as_they_were(hundredths):
    celsius = hundredths / 100
    assert to_celsius(to_kelvin(celsius)) == celsius
    assert to_kelvin(celsius) == pytest.approx(celsius + 273.15, abs=1e-6)
    kelvin = (27_315 + hundredths) / 100
    assert to_kelvin(to_celsius(kelvin)) == kelvin


def test_constants_follow_from_the_si():
    # The SI of 2019 fixes k and e exactly; the last digit given here is rounded.
    assert pytest.approx(1.380649e-23 / 1.602176634e-19, rel=1e-9) == BOLTZMANN
    # CODATA 2022, in F/m; 1e-6 m a um.
    assert pytest.approx(8.8541878188e-12 * 1e-6 / 1.602176634e-19, rel=1e-9) == (
        VACUUM_PERMITTIVITY
    )
