"""Devices: what is written reads back, what is wrong is refused by name, imports agree."""

from __future__ import annotations

import dataclasses
import math
import pickle
import re
from pathlib import Path

import galsim
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from bfsensor.device import (
    ORIGINS,
    ChannelStopDots,
    Device,
    Edge,
    EdgeStrip,
    Implant,
    Provenance,
    Ripple,
    builtin_devices,
)
from bfsensor.device_import import import_poisson_ccd
from bfsensor.errors import DeviceError

SENSORS = Path(galsim.meta_data.share_dir) / "sensors"
ITL = Device.load("itl_sta3800c")
E2V = Device.load("e2v_ccd250")


def refusal(call, *args, **kwargs):
    """Message of the DeviceError that a call raises."""
    with pytest.raises(DeviceError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


# -- round trips -------------------------------------------------------------------------


@pytest.mark.parametrize("name", builtin_devices())
def test_builtin_devices_survive_writing(name, tmp_path):
    device = Device.load(name)
    assert device.name == name
    assert device.provenance["silicon.thickness"] == Provenance(5.0, "published", None)
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


# -- refusals ----------------------------------------------------------------------------


def edited(pattern, replacement, device=ITL):
    """Text of a device with the first line that starts with ``pattern`` replaced."""
    text, count = re.subn(
        rf"(?m)^{re.escape(pattern)}.*$", replacement, device.to_toml(), count=1
    )
    assert count == 1
    return text


LIMITS = [
    (
        edited("pitch_x", 'pich_x = "10 um"'),
        "device: pixel: unknown key 'pich_x'; did you mean 'pitch_x'?",
    ),
    (
        edited("pitch_x", 'colour = "red"'),
        "device: pixel: unknown key 'colour'; allowed are pitch_x, pitch_y",
    ),
    (edited("pitch_x", ""), "device: pixel: pitch_x is missing"),
    (edited("[pixel]", "[pixle]"), "device: unknown key 'pixle'; did you mean 'pixel'?"),
    (
        'name = "bare"\n[pixel]\npitch_x = "10 um"\npitch_y = "10 um"\n',
        "device: section [silicon] is missing",
    ),
    (edited("name", ""), "device: name must be given as a string"),
    (edited("name", "name = 7"), "device: name must be given as a string"),
    (
        edited("thickness", 'thickness = "100"'),
        "device: silicon: thickness: '100' has no unit; expected one of length, such as um",
    ),
    (
        edited("thickness", "thickness = 100"),
        "device: silicon: thickness = 100 must be a string with a unit, such as '100 um'",
    ),
    (
        edited("thickness", 'thickness = "100 V"'),
        "device: silicon: thickness: '100 V' is not a length; expected a unit such as um",
    ),
    (
        edited("thickness", 'thickness = "-100 um"'),
        "device: silicon: thickness = '-100 um' must be at least 5 um",
    ),
    (
        edited("thickness", 'thickness = "1 m"'),
        "device: silicon: thickness = '1 m' must be at most 1000 um",
    ),
    (
        edited("pitch_x", 'pitch_x = "0 um"'),
        "device: pixel: pitch_x = '0 um' must be above 0 um",
    ),
    *(
        (
            edited("thickness", f'thickness = "{value} um"'),
            f"device: silicon: thickness = '{value} um' must be finite",
        )
        for value in ("nan", "inf", "-inf")
    ),
    (
        edited("peak", 'peak = "99.5 um"'),
        # 99.5 um + 4 sigma of 0.15 um; 100 um of which 1 um is field oxide
        "device: channel.implant[0]: the implant ends 100.1 um below the surface, outside "
        "the silicon of 99 um",
    ),
    (
        edited("peak", 'depth = "1 um"'),
        "device: channel.implant[0]: peak is missing for a gaussian implant",
    ),
    (
        edited("shape", 'shape = "box"\ndepth = "1 um"'),
        "device: channel.implant[0]: peak does not belong to a box implant",
    ),
    (
        edited("shape", 'shape = "triangle"'),
        "device: channel.implant[0]: shape = 'triangle' must be one of gaussian, box",
    ),
    (
        edited("collecting_phases", "collecting_phases = 3"),
        "device: gates: collecting_phases = 3 must be from 1 to phases - 1 = 2",
    ),
    (
        edited("collecting_phases", "collecting_phases = 1.5"),
        "device: gates: collecting_phases = 1.5 must be a whole number",
    ),
    (edited("phases", "phases = 1"), "device: gates: phases = 1 must be from 2 to 8"),
    (
        edited("width", 'width = "11 um"'),
        "device: channel_stop: width / 2 + field_oxide_taper = 6.6 um must be below half "
        "the pixel, 5 um",
    ),
    (
        edited("side_diffusion", 'side_diffusion = "4.2 um"'),
        "device: channel_stop: width / 2 + side_diffusion = 5.1 um must be below half the "
        "pixel, 5 um",
    ),
    (
        edited("field_oxide", 'field_oxide = "0.05 um"'),
        "device: gates: field_oxide = '0.05 um' must be at least gate_oxide = '0.1 um'",
    ),
    *(
        (
            edited("gate_high", f'gate_high = "{value} V"'),
            f"device: operating_point: gate_high = '{value} V' must be above gate_low = "
            "'-8 V'",
        )
        for value in ("-8", "-9")
    ),
    (
        edited("pitch_x", 'pitch_x = { value = "10 um", origin = "dreamt" }'),
        "device: pixel: pitch_x: origin = 'dreamt' must be one of measured, published, "
        "fitted, guessed",
    ),
    (
        edited("pitch_x", 'pitch_x = { value = "10 um", orign = "fitted" }'),
        "device: pixel: pitch_x: unknown key 'orign'; did you mean 'origin'?",
    ),
    (
        edited("pitch_x", 'pitch_x = { origin = "fitted" }'),
        "device: pixel: pitch_x: value is missing",
    ),
    (
        edited("pitch_x", 'pitch_x = { value = "10 um", uncertainty = "1 V" }'),
        "device: pixel: pitch_x: uncertainty: '1 V' is not a length; expected a unit such "
        "as um",
    ),
    *(
        (
            edited("pitch_x", f'pitch_x = {{value = "9 um", uncertainty = "{value} um"}}'),
            f"device: pixel: pitch_x: uncertainty = '{value} um' must be finite and "
            "at least 0",
        )
        for value in ("-1", "nan")
    ),
    (
        edited("pitch_x", 'pitch_x = { value = "10 um", source = 5 }'),
        "device: pixel: pitch_x: source = 5 must be a string",
    ),
    (
        ITL.to_toml().replace("[[channel.implant]]", "[channel.implant]", 1).split(
            "[[channel.implant]]"
        )[0]
        + ITL.to_toml()[ITL.to_toml().index("[channel_stop]") :],
        "device: channel: implant must be a list of sections, [[channel.implant]]",
    ),
    (
        edited("centre", 'centre = "11 um"', E2V),
        "device: channel_stop.dots: centre = '11 um' and height = '2.5 um' must lie within "
        "the pixel, 10 um",
    ),
    (
        ITL.to_toml()
        + '[edge]\nside = "x"\n[[edge.strip]]\nwidth = "9 um"\n'
        + '[[edge.strip.implant]]\nshape = "box"\ndose = "1e12 cm-2"\ndepth = "99.5 um"\n',
        "device: edge.strip[0].implant[0]: the implant ends 99.5 um below the surface, "
        "outside the silicon of 99 um",
    ),
    (
        ITL.to_toml() + '[edge]\nside = "z"\n',
        "device: edge: side = 'z' must be one of x, y",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), LIMITS, ids=[m[8:60] for _, m in LIMITS])
def test_wrong_files_are_refused(text, message):
    assert refusal(Device.from_toml, text) == message


def test_box_without_depth():
    text = edited("shape", 'shape = "box"')
    text = re.sub(r"(?m)^(peak|sigma).*\n", "", text, count=2)
    assert refusal(Device.from_toml, text) == (
        "device: channel.implant[0]: depth is missing for a box implant"
    )


def test_values_given_in_code_are_checked_like_those_of_a_file():
    wrong = dataclasses.replace(ITL.silicon, thickness=math.nan)
    assert refusal(dataclasses.replace, ITL, silicon=wrong) == (
        "silicon: thickness = 'nan' must be finite"
    )


def test_files_that_are_not_devices(tmp_path):
    path = tmp_path / "sensor.toml"
    assert refusal(Device.load, path) == (
        f"{path}: cannot be read: [Errno 2] No such file or directory: '{path}'"
    )
    path.write_text("volts and bolts\n")
    assert refusal(Device.load, path).startswith("sensor.toml: not TOML: ")
    path.write_bytes(b"\xff\xfe name")
    assert refusal(Device.load, path).startswith(f"{path}: cannot be read: 'utf-8' codec")
    path.write_text(edited("thickness", 'thickness = "1 um"'))
    assert refusal(Device.load, path) == (
        "sensor.toml: silicon: thickness = '1 um' must be at least 5 um"
    )
    assert refusal(Device.load, "sensor") == (
        f"'sensor' is neither a built-in device ({', '.join(builtin_devices())}) nor a "
        ".toml file"
    )


# -- physics -----------------------------------------------------------------------------

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


# -- import ------------------------------------------------------------------------------


def assert_same_numbers(a, b, where):
    """All values equal to 1e-12 relative: both sides are a few roundings from the text."""
    assert type(a) is type(b), where
    if dataclasses.is_dataclass(a):
        for spec in dataclasses.fields(a):
            assert_same_numbers(
                getattr(a, spec.name), getattr(b, spec.name), f"{where}.{spec.name}"
            )
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same_numbers(x, y, f"{where}[{i}]")
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-12, abs=0), where
    else:
        assert a == b, where


@pytest.mark.parametrize(
    ("stem", "name"), [("lsst_itl_50_8", "itl_sta3800c"), ("lsst_e2v_50_8", "e2v_ccd250")]
)
def test_import_gives_the_builtin_devices(stem, name):
    imported = import_poisson_ccd(SENSORS / f"{stem}.cfg")
    builtin = Device.load(name)
    assert imported.name == stem
    for section in (
        "pixel", "material", "silicon", "gates", "channel", "channel_stop",
        "operating_point", "edge",
    ):  # fmt: skip
        assert_same_numbers(getattr(imported, section), getattr(builtin, section), section)
    assert Device.from_toml(imported.to_toml()) == imported
    assert pickle.loads(pickle.dumps(imported)) == imported


def changed_cfg(folder, key, value):
    """GalSim's ITL configuration with one line set to ``value`` (None: taken away)."""
    lines = (SENSORS / "lsst_itl_50_8.cfg").read_text().splitlines()
    kept = [line for line in lines if line.split("=")[0].strip() != key]
    path = folder / "itl.cfg"
    path.write_text(
        "\n".join([*kept, *([f"{key} = {value}"] if value is not None else [])])
    )
    return path


def test_import_evaluates_nothing(tmp_path, monkeypatch):
    witness = tmp_path / "witness"
    monkeypatch.chdir(tmp_path)
    for value in (
        '__import__("os").getcwd()',
        f'open("{witness}", "w").write("1")',
        "10 - 60",
        "-50.0 V",
        "'-50'",
    ):
        assert refusal(import_poisson_ccd, changed_cfg(tmp_path, "Vbb", value)) == (
            f"itl.cfg: Vbb = {value!r} is not a number"
        )
    assert not witness.exists()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("Vbb", None, "itl.cfg: Vbb is missing"),
        ("Vbb", "", "itl.cfg: Vbb = '' is not a number"),
        (
            "Vbb",
            "nan",
            "itl.cfg: operating_point: back_bias = 'nan' must be finite",
        ),
        ("Vbb", "50", "itl.cfg: operating_point: back_bias = '50 V' must be at most 0 V"),
        *(
            (key, value, f"itl.cfg: {key} = {value!r} is not a whole number")
            for key in ("NumPhases", "ChannelProfile")
            for value in ("2.5", "nan", "inf")
        ),
        ("ChannelProfile", "3", "itl.cfg: ChannelDose_2 is missing"),
        (
            "TreeRingAmplitude",
            "0.1",
            "itl.cfg: TreeRingAmplitude = 0.1: its period lacks a factor 2 pi there; give "
            "the ripple in the device file instead",
        ),
        (
            "GateGap",
            "0.2",
            "itl.cfg: GateGap = 0.2: gaps between gates are not modelled",
        ),
        (
            "NumberofFixedRegions",
            "1",
            "itl.cfg: NumberofFixedRegions = 1: fixed regions are not taken over; describe "
            "a guard ring as [edge] in the device file",
        ),
    ],
)
def test_import_refuses(key, value, message, tmp_path):
    assert refusal(import_poisson_ccd, changed_cfg(tmp_path, key, value)) == message


def test_import_reads_square_profiles(tmp_path):
    path = changed_cfg(tmp_path, "ChannelProfile", "0")
    path.write_text(path.read_text() + "\nChannelDoping = 1.0E12\nChannelDepth = 1.0\n")
    (implant,) = import_poisson_ccd(path).channel.implants
    assert_same_numbers(implant, Implant("box", 1e4, depth=1.0), "implant")


def test_import_of_other_files(tmp_path):
    path = tmp_path / "notes.cfg"
    path.write_text("nothing\n# Vbb = 7\n")
    assert refusal(import_poisson_ccd, path) == (
        f"{path}: not a Poisson_CCD configuration: no line of the form key = value"
    )
    path.write_bytes(b"\xff\xfeVbb = 3")
    assert refusal(import_poisson_ccd, path).startswith(f"{path}: cannot be read: ")
    missing = tmp_path / "missing.cfg"
    assert refusal(import_poisson_ccd, missing).startswith(f"{missing}: cannot be read: ")


@pytest.mark.parametrize(
    "line", ["qfh1 = 1.0", "TopSurfaceDoping = 1e12", "ChannelStopDopng = -1e12"]
)
def test_import_refuses_device_keys_that_it_does_not_know(tmp_path, line):
    source = Path(galsim.meta_data.share_dir) / "sensors" / "lsst_itl_50_8.cfg"
    path = tmp_path / "other.cfg"
    path.write_text(f"{source.read_text()}\n{line}\n")
    key = line.split()[0]
    with pytest.raises(DeviceError, match=rf"other\.cfg: {key} is not a key"):
        import_poisson_ccd(path)
