"""Pages of device files and campaigns list what the readers of these files accept, no more."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict

import numpy as np
import pytest
import yaml

from bfsensor.device.device import Device
from bfsensor.device.file_keys import MEANINGS, device_keys
from bfsensor.errors import DeviceError, RecordingError
from bfsensor.recording.campaign import settings as settings_module
from bfsensor.recording.campaign.file_keys import CAMPAIGN_KEYS, QUANTITY_MEANINGS
from bfsensor.recording.campaign.manifest import COLUMNS
from bfsensor.recording.campaign.settings import ENTRIES, CampaignSettings, read_settings
from bfsensor.recording.raw.keywords import MEANINGS as QUANTITIES
from tests.docs.pages import load, tables

PAGES = load("reference_pages")
KEYS = device_keys()

WHOLE = """
name = "whole"
[pixel]
pitch_x = "10 um"
pitch_y = "10 um"
[material]
[silicon]
thickness = "100 um"
background_doping = "-1e12 cm-3"
[[silicon.ripple]]
kind = "plane"
amplitude = "0.1"
period = "100 um"
[gates]
phases = 3
collecting_phases = 1
gate_oxide = "0.1 um"
field_oxide = "1 um"
[channel]
[[channel.implant]]
shape = "gaussian"
dose = "1e12 cm-2"
peak = "0.1 um"
sigma = "0.1 um"
[channel_stop]
width = "1 um"
[[channel_stop.implant]]
shape = "box"
dose = "-1e12 cm-2"
depth = "1 um"
[channel_stop.dots]
centre = "5 um"
height = "2 um"
[[channel_stop.dots.implant]]
shape = "box"
dose = "-1e12 cm-2"
depth = "1 um"
[operating_point]
gate_low = "-8 V"
gate_high = "2 V"
back_bias = "-50 V"
temperature = "173 K"
[well]
[transport]
[edge]
side = "x"
[[edge.strip]]
width = "10 um"
[[edge.strip.implant]]
shape = "box"
dose = "-1e12 cm-2"
depth = "1 um"
[image_charge]
charge_height = "1 um"
row_height = "1.4 um"
column_height = "3.2 um"
half_width_x = "2 um"
half_width_y = "2 um"
drift_field_front = "0.7 V/um"
drift_field_back = "0.4 V/um"
"""
"""A device that has every section."""


def with_entry(header, line):
    """The device's text with a line in a section, in the place of one of the same key."""
    key = line.partition(" =")[0]
    before, _, after = WHOLE.partition(f"\n{header}")
    body, bracket, rest = after.rstrip("\n").partition("\n[")
    kept = [one for one in body.splitlines() if not one.startswith(f"{key} =")]
    return "\n".join([before, header, *kept[1:], line]) + (bracket or "\n") + rest


def test_the_device_with_all_sections_is_accepted():
    Device.from_toml(WHOLE)


def headers():
    return list(dict.fromkeys(key.section for key in KEYS))


@pytest.mark.parametrize("header", headers())
def test_the_reader_allows_the_keys_of_the_page(header):
    with pytest.raises(DeviceError, match="unknown key") as caught:
        Device.from_toml(with_entry(header, "qqqqqqqq = 1"))
    allowed = str(caught.value).rpartition("allowed are ")[2].split(", ")
    assert set(allowed) == {key.key for key in KEYS if key.section == header}


@pytest.mark.parametrize("header", headers())
def test_what_the_page_calls_required_is_missed(header):
    assert header in WHOLE
    for key in (k for k in KEYS if k.section == header and k.default == "required"):
        text = with_entry(header, f"{key.key} = 0").replace(f"{key.key} = 0\n", "", 1)
        with pytest.raises(DeviceError, match=rf"{key.key} is missing"):
            Device.from_toml(text)


def number(text):
    return float(text.split()[0])


def refused(key, value):
    """Whether a value is refused for its range; other keys of the device may disagree with it."""
    line = f'{key.key} = "{value:.15g} {key.unit}"'.replace(' "', '"').replace('="', '= "')
    try:
        Device.from_toml(with_entry(key.section, line))
    except DeviceError as error:
        found = re.search(
            rf"\b{key.key} = '?[^:]*must be (above|at least|at most) ([^']*)", str(error)
        )
        return found is not None and bool(re.search(r"[\d.]", found[2]))
    return False


RANGED = [k for k in KEYS if re.match(r"(above |at least |at most )?-?[\d.]", k.allowed)]


@pytest.mark.parametrize("key", RANGED, ids=lambda k: f"{k.section}{k.key}")
def test_ranges_of_the_page_are_the_readers(key):
    low, to, high = key.allowed.removeprefix("at least ").partition(" to ")
    above = low.startswith("above ")
    low = number(low.removeprefix("above "))
    assert refused(key, low - 1e-3 * max(abs(low), 1e-3))
    assert refused(key, low) == above
    if to:
        assert refused(key, number(high) * (1 + 1e-9) + 1e-9)


def test_numbers_of_phases_are_those_of_the_page():
    meanings = {k.key: k.meaning for k in KEYS if k.section == "[gates]"}
    low, high = map(int, re.search(r"from (\d+) to (\d+)", meanings["phases"]).groups())
    first = int(re.search(r"from (\d+) to phases - 1", meanings["collecting_phases"])[1])

    def accepted(phases, collecting):
        try:
            Device.from_toml(
                WHOLE.replace("phases = 3", f"phases = {phases}")
                .replace("collecting_phases = 1", f"collecting_phases = {collecting}")
            )  # fmt: skip
        except DeviceError:
            return False
        return True

    assert accepted(low, first) and accepted(high, first) and accepted(high, high - 1)
    assert not accepted(low - 1, first) and not accepted(high + 1, first)
    assert not accepted(high, first - 1) and not accepted(high, high)


def test_defaults_of_the_page_are_those_of_the_device():
    plain = WHOLE
    device = Device.from_toml(plain)
    for key in KEYS:
        if not re.match(r"-?[\d.]", key.default):
            continue
        line = f'{key.key} = "{key.default}"'
        assert Device.from_toml(with_entry(key.section, line)) == device, key


def test_meanings_have_no_keys_that_are_gone():
    assert len(MEANINGS) == len(
        {(k.section.count("implant"), k.key, k.meaning) for k in KEYS}
    )
    assert all(k.meaning.endswith(".") for k in KEYS)


def test_the_page_of_device_files_has_every_key():
    page = PAGES.device_file_page()
    found = tables(page)
    for key in KEYS:
        rows = found["Implants" if "implant]]" in key.section else key.section]
        assert [key.key, key.unit, key.default, key.allowed, key.meaning] in rows
    assert sum(map(len, found.values())) == len(KEYS) - 3 * 5  # implants stand once
    example = re.search(r"```toml\n(.*?)```", page, re.DOTALL)[1]
    line = example.splitlines()[1]
    known = Device.from_toml(with_entry("[silicon]", line)).provenance["silicon.thickness"]
    assert known.uncertainty == 5.0
    assert tomllib.loads(example)["silicon"]["thickness"]["origin"] == known.origin


# -- campaigns -------------------------------------------------------------------------


class Watched(dict):
    """A mapping that keeps which keys it was asked for, by its own name."""

    def __init__(self, given, name, asked):
        super().__init__(given)
        self.name, self.asked = name, asked

    def get(self, key, default=None):
        self.asked[self.name].add(key)
        return super().get(key, default)


@pytest.fixture
def folder(tmp_path):
    for name in ("exposures.ecsv", "device_card.json"):
        (tmp_path / name).write_text("")
    return tmp_path


def read(folder, text):
    (folder / "campaign.yaml").write_text(text)
    return read_settings(folder)


@pytest.mark.parametrize("key", CAMPAIGN_KEYS, ids=lambda k: k.key)
def test_every_key_of_a_campaign_is_read(folder, key):
    found = read(folder, key.example + "\n")
    assert found.remarks == ()
    if key.key == "schema":
        with pytest.raises(RecordingError, match="schema"):
            read(folder, "schema: another\n")
        return
    assert found != CampaignSettings()
    # The example shows this key: without it the settings are others.
    path = key.key.replace("[]", "").replace("QUANTITY.", "").split(".")
    assert path[-1] in key.example or "QUANTITY" in key.key
    assert list(yaml.safe_load(key.example)) == path[:1]


def test_keys_of_campaigns_are_those_that_are_read(folder, monkeypatch):
    asked = defaultdict(set)
    names = ("lamp_monitor", "spots", "pairs")
    monkeypatch.setattr(
        settings_module, "load_yaml",
        lambda text: {n: Watched({"other": 1}, n, asked) for n in names},
    )  # fmt: skip
    read(folder, "")
    listed = defaultdict(set)
    for key in CAMPAIGN_KEYS:
        first, _, inner = key.key.replace("[]", "").partition(".")
        listed[first].add(inner.removeprefix("QUANTITY").removeprefix("."))
    assert set(listed) == set(ENTRIES)
    assert {n: listed[n] for n in names} == dict(asked)


def test_entries_of_amplifiers_and_keywords_are_those_that_are_read(folder):
    inner = {k.key.partition("[].")[2] for k in CAMPAIGN_KEYS if "[]" in k.key}
    with pytest.raises(RecordingError) as caught:
        read(folder, "amplifiers: [{name: A, other: 1}]\n")
    assert set(str(caught.value).rpartition(" but ")[2].split(", ")) == inner
    with pytest.raises(RecordingError) as caught:
        read(folder, "keywords: {kind: {other: 1}}\n")
    words = set(str(caught.value).rpartition(" of ")[2].split(", "))
    assert words == {
        k.key.rpartition(".")[2] for k in CAMPAIGN_KEYS if ".QUANTITY." in k.key
    }


def test_the_default_tolerance_of_pairs_is_that_of_the_page():
    key = next(k for k in CAMPAIGN_KEYS if k.key == "pairs.tolerance")
    stated = float(re.search(r"[\d.]+\d", key.meaning)[0])
    assert stated == CampaignSettings().pair_tolerance


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("lamp_monitor.relative_error", 0), ("spots.grid_px", -1), ("pairs.tolerance", "x")],
)
def test_numbers_of_campaigns_are_above_0(folder, name, wrong):
    assert {k.key: k.allowed for k in CAMPAIGN_KEYS}[name] == "above 0"
    first, _, inner = name.partition(".")
    with pytest.raises(RecordingError, match="above 0"):
        read(folder, f"{first}: {{{inner}: {wrong}}}\n")


def test_the_page_of_campaigns_has_every_key_quantity_and_column():
    found = tables(PAGES.campaign_page())
    assert [row[0] for row in found["campaign.yaml"]] == [k.key for k in CAMPAIGN_KEYS]
    assert [row[0] for row in found["Quantities of headers"]] == list(QUANTITIES)
    assert set(QUANTITY_MEANINGS) == set(QUANTITIES)
    rows = {row[0]: row for row in found["Columns of manifest.ecsv"]}
    assert list(rows) == [", ".join(words) for words in COLUMNS.values()]
    for row in found["Quantities of headers"]:
        one = QUANTITIES[row[0]]
        if np.isfinite(one.low):
            assert f"{one.low:g}" in row[3]
        assert row[4] == ", ".join(one.keywords)
