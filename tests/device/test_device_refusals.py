"""Device files: what is wrong is refused by name."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest

from bfsensor.device.device import (
    Device,
    builtin_devices,
)
from tests.device.device_cases import E2V, ITL, refusal


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
