"""Devices: what is written reads back, values change by name, doping is as drawn."""

from __future__ import annotations

import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from bfsensor.device.device import ORIGINS, Device, builtin_devices
from bfsensor.device.parts import (
    ChannelStopDots,
    Edge,
    EdgeStrip,
    ElectronTransport,
    Implant,
    Provenance,
    Ripple,
)
from bfsensor.errors import DeviceError
from tests.device.device_cases import E2V, ITL, refusal


@pytest.mark.parametrize("name", builtin_devices())
def test_builtin_devices_survive_writing(name, tmp_path):
    device = Device.load(name)
    assert device.name == name
    known = device.provenance["silicon.thickness"]
    if name.endswith("_2019"):
        # A fit narrows what its prior was.
        assert known.origin == "fitted" and 0 < known.uncertainty <= 5.0 and known.source
    elif device.image_charge is not None:
        assert known.source == "stated with the covariances"
    else:
        assert known == Provenance(5.0, "published", None)
    again = Device.from_toml(device.to_toml())
    assert again == device
    assert dict(again.provenance) == dict(device.provenance)
    path = tmp_path / "copy.toml"
    device.write(path)
    assert Device.load(path) == Device.from_toml(path) == device
    assert [p.name for p in tmp_path.iterdir()] == ["copy.toml"]


@pytest.mark.parametrize("name", builtin_devices())
@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_pickling(name, protocol):
    device = Device.load(name)
    again = pickle.loads(pickle.dumps(device, protocol))
    assert again == device
    assert hash(again) == hash(device)


def finite(low, high):
    return st.floats(low, high, allow_subnormal=False)


gaussians = st.builds(
    Implant,
    st.just("gaussian"),
    finite(-1e5, 1e5),
    peak=finite(0, 3),
    sigma=finite(0.01, 1),
)
boxes = st.builds(Implant, st.just("box"), finite(-1e5, 1e5), depth=finite(0.01, 4))
implants = st.lists(gaussians | boxes, max_size=3).map(tuple)
ripples = st.builds(
    Ripple,
    st.sampled_from(["plane", "radial"]),
    finite(0, 1),
    finite(0.1, 1e4),
    *[finite(-10, 10)] * 2,
    *[finite(-1e5, 1e5)] * 2,
)
strips = st.builds(
    EdgeStrip,
    finite(0.1, 500),
    st.none() | finite(-100, 100),
    st.sampled_from(["none", "gate", "field"]),
    implants,
)
edges = st.none() | st.builds(
    Edge, st.sampled_from(["x", "y"]), st.lists(strips, max_size=2).map(tuple)
)
dots = st.none() | st.builds(
    ChannelStopDots, finite(0, 5), finite(0.1, 5), finite(-1e5, 1e5), implants
)
known = st.builds(
    Provenance,
    st.none() | finite(0, 1e5),
    st.none() | st.sampled_from(ORIGINS),
    # No lone surrogates: a file in UTF-8 cannot hold them.
    st.none() | st.text(st.characters(codec="utf-8"), max_size=20),
)


@st.composite
def any_device(draw):
    """A valid device, far from the built-in ones."""
    replace = dataclasses.replace
    low = draw(finite(-20, 5))
    keys = draw(
        st.sets(
            st.sampled_from(
                ["pixel.pitch_x", "silicon.background_doping", "channel.surface_charge",
                 "operating_point.back_bias", "material.band_gap", "well.spill_barrier"]
            )
        )
    )  # fmt: skip
    return Device(
        name=draw(st.text(st.characters(codec="utf-8"), min_size=1, max_size=12)),
        pixel=replace(ITL.pixel, pitch_x=draw(finite(8, 50)), pitch_y=draw(finite(8, 50))),
        material=replace(
            ITL.material,
            permittivity_oxide=draw(finite(1, 100)),
            density_of_states=draw(finite(1e-3, 1e9)),
            thermal_voltage_300K=draw(st.none() | finite(0.001, 1)),
        ),
        silicon=replace(
            ITL.silicon,
            thickness=draw(finite(20, 1000)),
            background_doping=draw(finite(-1e4, 1e4)),
            ripples=tuple(draw(st.lists(ripples, max_size=2))),
        ),
        gates=replace(
            ITL.gates,
            phases=draw(st.integers(3, 8)),
            field_oxide=draw(finite(0.1, 5)),
            field_oxide_taper=draw(finite(0, 1)),
        ),
        channel=replace(
            ITL.channel, surface_charge=draw(finite(-1e5, 1e5)), implants=draw(implants)
        ),
        channel_stop=replace(
            ITL.channel_stop,
            width=draw(finite(0, 4)),
            implants=draw(implants),
            dots=draw(dots),
        ),
        operating_point=replace(
            ITL.operating_point,
            gate_low=low,
            gate_high=low + draw(finite(0.1, 20)),
            back_bias=draw(finite(-500, 0)),
            temperature=draw(finite(77, 350)),
        ),
        well=replace(ITL.well, spill_barrier=draw(finite(0.01, 10))),
        edge=draw(edges),
        provenance={key: draw(known) for key in keys},
    )


@settings(max_examples=60, deadline=None)
@given(device=any_device())
def test_any_device_survives_writing(device):
    text = device.to_toml()
    again = Device.from_toml(text)
    assert again == device
    assert dict(again.provenance) == dict(device.provenance)
    assert again.to_toml() == text


def test_edge_strips_are_read_and_written():
    text = ITL.to_toml() + (
        '\n[edge]\nside = "x"\n'
        '\n[[edge.strip]]\nwidth = "40 um"\nvoltage = "-10 V"\noxide = "gate"\n'
        '\n[[edge.strip.implant]]\nshape = "box"\ndose = "-1e12 cm-2"\ndepth = "2 um"\n'
        '\n[[edge.strip]]\nwidth = "0.1 mm"\n'
    )
    device = Device.from_toml(text)
    assert device.edge == Edge(
        "x",
        (
            EdgeStrip(40.0, -10.0, "gate", (Implant("box", -1e4, depth=2.0),)),
            EdgeStrip(100.0, None, "field"),
        ),
    )
    assert not device.is_mirror_symmetric
    assert ITL.is_mirror_symmetric
    assert Device.from_toml(device.to_toml()) == device


# -- changing values ---------------------------------------------------------------------


@pytest.mark.parametrize("key", ["operating_point.back_bias", "back_bias"])
def test_with_value_takes_dotted_and_short_names(key):
    changed = ITL.with_value(key, "-61000 mV")
    assert changed.operating_point.back_bias == -61.0
    assert ITL.operating_point.back_bias == -50.0
    # What was known about the old value is not known about the new one; the rest is.
    gone = set(ITL.provenance) - set(changed.provenance)
    assert gone == {"operating_point.back_bias"}
    assert changed.with_value("back_bias", "-50 V") == dataclasses.replace(
        ITL, provenance=changed.provenance
    )
    assert ITL.with_operating_point(back_bias="-61 V") == changed


def test_physics_has_neither_name_nor_provenance_nor_transport():
    there_and_back = ITL.with_value("back_bias", "-61 V").with_value("back_bias", "-50 V")
    assert there_and_back != ITL and there_and_back.physics == ITL.physics
    renamed = dataclasses.replace(ITL, name="another")
    assert renamed.physics == ITL.physics
    assert ITL.with_value("back_bias", "-61 V").physics != ITL.physics
    assert (
        dataclasses.replace(
            Device.from_toml(ITL.physics),
            name=ITL.name,
            provenance=ITL.provenance,
            transport=ITL.transport,
        )
        == ITL
    )  # nothing else is left out


def test_with_value_takes_whole_numbers():
    assert E2V.with_value("collecting_phases", "3").gates.collecting_phases == 3


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (
            "surface_charge",
            "1e11 cm-2",
            "no quantity 'surface_charge' in a device; did you mean channel.surface_charge "
            "or channel_stop.surface_charge?",
        ),
        (
            "back_bais",
            "-60 V",
            "no quantity 'back_bais' in a device; did you mean back_bias?",
        ),
        ("zzz", "1 um", "no quantity 'zzz' in a device"),
        ("edge.side", "x", "no quantity 'edge.side' in a device"),
        ("implants", "1 um", "no quantity 'implants' in a device"),
        ("phases", "3.5", "gates: phases = '3.5' must be a whole number"),
        ("phases", "9", "gates: phases = 9 must be from 2 to 8"),
        (
            "back_bias",
            "-60",
            "operating_point: back_bias: '-60' has no unit; expected one of potential, "
            "such as V",
        ),
        (
            "back_bias",
            "60 V",
            "operating_point: back_bias = '60 V' must be at most 0 V",
        ),
        ("pitch_x", "nan um", "pixel: pitch_x = 'nan um' must be finite"),
    ],
)
def test_with_value_refuses(key, value, message):
    assert refusal(ITL.with_value, key, value) == message


SHAPES = [
    Implant("gaussian", 9600.0, peak=0.07, sigma=0.15),  # cut by the surface
    Implant("gaussian", -45000.0, peak=2.0, sigma=0.39),
    Implant("box", -8000.0, depth=0.7),
]


@pytest.mark.parametrize("implant", SHAPES, ids=lambda i: f"{i.shape} {i.dose:g}")
def test_cumulative_integrates_density(implant):
    at = np.linspace(0, implant.reach, 14)
    expected = [
        quad(lambda d: float(implant.density(d)), 0, z, epsrel=1e-12)[0] for z in at
    ]
    # Smooth integrands on [0, reach]: the quadrature is good to 1e-12 of the dose.
    np.testing.assert_allclose(
        implant.cumulative(at), expected, rtol=0, atol=1e-11 * abs(implant.dose)
    )
    assert implant.cumulative(np.array([0.0]))[0] == 0.0
    outside = np.array([implant.reach, implant.reach + 0.1, 1e3])
    # At the end erf(a) - erf(b) is divided by itself: exact but for one rounding.
    np.testing.assert_allclose(implant.cumulative(outside), implant.dose, rtol=4e-16)
    beyond = np.array([-0.1, 1.01 * implant.reach])
    assert np.all(implant.density(beyond) == 0)


def test_gaussian_density_has_its_shape():
    implant = SHAPES[1]
    at = np.array([implant.peak, implant.peak + implant.sigma])
    peak, shoulder = implant.density(at)
    assert shoulder / peak == pytest.approx(math.exp(-0.5), rel=1e-12)
    assert implant.reach == pytest.approx(2.0 + 4 * 0.39, rel=1e-15)


def test_plane_ripple():
    ripple = Ripple("plane", 0.25, 40.0, phase=0.3, direction=math.pi / 2)
    x, y = np.array([0.0, 17.0, -3.0]), np.array([0.0, 10.0, 40.0])
    # Along y; by hand: a quarter period on, cos becomes -sin.
    expected = [
        1 + 0.25 * math.cos(0.3),
        1 - 0.25 * math.sin(0.3),
        1 + 0.25 * math.cos(0.3),
    ]
    np.testing.assert_allclose(ripple.factor(x, y), expected, rtol=1e-14)


def test_radial_ripple():
    ripple = Ripple("radial", 0.1, 10.0, centre_x=3.0, centre_y=-4.0)
    x, y = np.array([3.0, 6.0, 3.0]), np.array([-4.0, 0.0, 6.0])
    # Distances 0, 5 and 10 um: a crest, a trough, a crest.
    np.testing.assert_allclose(ripple.factor(x, y), [1.1, 0.9, 1.1], rtol=1e-14)


def test_thermal_voltage():
    # kT/q at 300 K is 25.852 mV; the published constant is 26 mV.
    plain = dataclasses.replace(ITL.material, thermal_voltage_300K=None)
    assert plain.thermal_voltage(300.0) == pytest.approx(0.025852, abs=5e-7)
    assert ITL.material.thermal_voltage(150.0) == pytest.approx(0.013, rel=1e-15)


def test_the_width_of_the_diffusion_is_a_quantity_without_part_in_solutions():
    from bfsensor.device.parameters import device_parameters

    assert ITL.diffusion == ITL.transport.diffusion == 1.92
    known = ITL.provenance["transport.diffusion"]
    assert (
        known.origin == "published"
        and known.uncertainty == 0.2
        and "GalSim" in known.source
    )
    changed = ITL.with_value("transport.diffusion", "2.12")
    assert changed.diffusion == 2.12 and changed.physics == ITL.physics
    assert Device.from_toml(changed.to_toml()) == changed != ITL
    assert "transport.diffusion" not in device_parameters(ITL)
    bare = dataclasses.replace(ITL, transport=ElectronTransport(), provenance={})
    assert "transport" not in bare.to_toml() and bare.diffusion == 1.0
    assert bare.with_value("transport.diffusion", "1.5").diffusion == 1.5
    assert "1.92 +- 0.2 times" in str(ITL) and "times the width" not in str(bare)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('diffusion = "1.92 um"', "expected no unit"),
        ('diffusion = "-0.1"', "must be at least 0"),
        ('diffusion = "11"', "must be at most 10"),
        ("diffusion = 1.92", "must be a string"),
        ('width = "1.92"', "unknown key 'width'"),
    ],
)
def test_other_widths_of_the_diffusion_are_refused(line, message):
    text = ITL.to_toml().partition("[transport]")[0] + f"[transport]\n{line}\n"
    with pytest.raises(DeviceError, match=message):
        Device.from_toml(text)
