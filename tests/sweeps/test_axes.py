"""Axes of sweeps: values with units, combinations, refusals that name the allowed values."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bfsensor.device.device import Device
from bfsensor.errors import DeviceError, SweepError
from bfsensor.sweeps.axes import Swept, combine, parse_swept

ITL = Device.load("itl_sta3800c")


@pytest.mark.parametrize(
    ("key", "text", "name", "unit", "values"),
    [
        ("back_bias", "-30V:-70V:5", "operating_point.back_bias", "V", (-30, -40, -50, -60, -70)),
        ("back_bias", "-30V, -7e4mV", "operating_point.back_bias", "V", (-30, -70)),
        ("silicon.thickness", "0.08mm,100um", "silicon.thickness", "um", (80, 100)),
        ("wavelength", "400nm:1um:4", "wavelength", "nm", (400, 600, 800, 1000)),
        ("phases", "3,4", "gates.phases", "", (3, 4)),
        ("permittivity_oxide", "3.9:4.3:2", "material.permittivity_oxide", "", (3.9, 4.3)),
        ("background_doping", "-1e12cm-3", "silicon.background_doping", "cm-3", (-1e12,)),
    ],
)  # fmt: skip
def test_values_are_read_with_their_units(key, text, name, unit, values):
    found = parse_swept(key, text, ITL)
    assert (found.name, found.unit, found.values) == (name, unit, values)
    if name != "wavelength":  # what the texts make of a device is what the values say
        section, _, last = name.partition(".")
        for given_text, value in zip(found.texts, values, strict=True):
            changed = getattr(getattr(ITL.with_value(name, given_text), section), last)
            scale = 1e-12 if unit == "cm-3" else 1.0
            assert changed == pytest.approx(value * scale, rel=1e-15)


@pytest.mark.parametrize(
    ("key", "text", "error", "message"),
    [
        ("backbias", "-30V", DeviceError, "itl_sta3800c: pixel.pitch_x"),
        ("backbias", "-30V", DeviceError, "operating_point.back_bias"),
        ("back_bias", "-30", DeviceError, "operating_point.back_bias: '-30'"),
        ("back_bias", "-30um", DeviceError, "operating_point.back_bias: '-30um'"),
        ("back_bias", "-30V:-70V", SweepError, "operating_point.back_bias: '-30V:-70V'"),
        ("back_bias", "-30V:-70V:1", SweepError, "'-30V:-70V:1'"),
        ("back_bias", "-30V:-70V:-3", SweepError, "'-30V:-70V:-3'"),
        ("back_bias", "-30V,:-70V:3", SweepError, "'-30V,:-70V:3'"),
        ("back_bias", "-30V,", DeviceError, "operating_point.back_bias: ''"),
        ("wavelength", "620", DeviceError, "wavelength: '620'"),
        ("wavelength", "-1nm", DeviceError, "wavelength: -1 nm"),
        ("phases", "3.5", DeviceError, "gates.phases: '3.5'"),
        ("phases", "3:4:3", DeviceError, "gates.phases: '3:4:3'"),
    ],
)  # fmt: skip
def test_what_cannot_be_swept_is_refused(key, text, error, message):
    with pytest.raises(error) as caught:
        parse_swept(key, text, ITL)
    assert message in str(caught.value)


@given(counts=st.lists(st.integers(1, 4), min_size=1, max_size=3))
def test_a_grid_holds_every_combination_once(counts):
    swept = [Swept(f"s.q{n}", "V", (0.0,) * c, ("0 V",) * c) for n, c in enumerate(counts)]
    points = combine(swept)
    size = 1
    for count in counts:
        size *= count
    assert len(points) == len(set(points)) == size
    assert all(
        n < count for point in points for n, count in zip(point, counts, strict=True)
    )


def test_pairs_and_what_does_not_pair():
    bias, thickness = (
        parse_swept("back_bias", "-30V,-50V", ITL),
        parse_swept("thickness", "80um:100um:3", ITL),
    )
    assert combine([bias, bias.__class__("a.b", "", (1.0, 2.0), ("1", "2"))], paired=True) == [
        (0, 0), (1, 1),
    ]  # fmt: skip
    with pytest.raises(SweepError, match="back_bias 2, thickness 3"):
        combine([bias, thickness], paired=True)
    with pytest.raises(SweepError, match=r"operating_point\.back_bias"):
        combine([bias, bias])
    with pytest.raises(SweepError, match="nothing to sweep over"):
        combine([])
