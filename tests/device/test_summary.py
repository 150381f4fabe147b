"""Devices and tables print what they are, with units, in a few lines."""

from __future__ import annotations

import dataclasses
import html
import pickle
import re
from html.parser import HTMLParser

import pytest

from bfsensor.device.device import Device, builtin_devices
from bfsensor.device.summary import MOST_LINES, WIDTH, format_summary
from bfsensor.errors import DeviceError, TableError
from bfsensor.table.table import DistortionTable


class Cells(HTMLParser):
    """The texts of a table, and whether its tags close."""

    def __init__(self, text):
        super().__init__()
        self.open, self.texts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


@pytest.mark.parametrize("name", builtin_devices())
@pytest.mark.parametrize("kind", [Device, DistortionTable])
def test_what_is_printed_is_short_and_the_same_in_a_notebook(kind, name):
    shown = kind.load(name)
    lines = str(shown).splitlines()
    assert 8 <= len(lines) <= MOST_LINES and max(map(len, lines)) <= WIDTH
    cells = Cells(shown._repr_html_())
    assert not cells.open
    assert " ".join(" ".join(cells.texts).split()) == " ".join(str(shown).split())
    assert len(repr(shown)) < 120 and "\n" not in repr(shown) and name in repr(shown)
    assert pickle.loads(pickle.dumps(shown)) == shown


def test_a_device_says_what_it_is_made_of_and_how_it_is_operated():
    text = str(Device.load("e2v_ccd250").with_value("back_bias", "-61.5 V"))
    for said in (
        "Device e2v_ccd250", "100 +- 5 um", "-2.4e12 +- 8e11 cm-3 (acceptors)", "4 phases, 2",
        "0.15 +- 0.01 um", "-61.5 V", "-6 V (low), 3.5 V (high", "173 K (-100 C)", "1.1 +- 1 V",
    ):  # fmt: skip
        assert said.replace("e1", "e+1") in text, text


def test_a_table_says_its_levels_its_errors_and_how_it_was_made():
    table = DistortionTable.load("itl_sta3800c")
    text = " ".join(str(table).split())
    assert f"{table.full_well:,.0f} e-" in text and table.provenance["version"] in text
    for charge in table.charges:
        assert f"{charge:,.0f}" in text
    for name, value in table.errors.items():
        plain, _, unit = name.rstrip("]").partition(" [")
        assert f"{plain} {value:.2g} {unit}".rstrip() in text
    unknown = dataclasses.replace(table, device_text="", full_well=float("nan"), errors={})
    text = " ".join(str(unknown).split())
    assert "device not known, 100 um thick" in text and "full well not known" in text
    assert re.fullmatch(r"<DistortionTable, 7 charges.*>", repr(unknown))


def test_names_are_no_markup():
    device = dataclasses.replace(Device.load("e2v_ccd250"), name="<b>&")
    assert html.escape("Device <b>&") in device._repr_html_()


def test_long_summaries_say_how_much_is_left_out():
    rows = [(f"row {n}", "x") for n in range(40)]
    lines = format_summary("Title", rows).splitlines()
    assert len(lines) == MOST_LINES and lines[-1] == "  ... and 12 lines more"


@pytest.mark.parametrize(
    ("given", "meant"),
    [("e2v", "e2v_ccd250"), ("E2V_CCD25O", "e2v_ccd250"), ("itl_sta3800", "itl_sta3800c")],
)
def test_wrong_names_are_answered_with_the_one_that_was_meant(given, meant):
    with pytest.raises(TableError, match=rf"{given}' is not a table.*mean {meant}"):
        DistortionTable.load(given)
    with pytest.raises(DeviceError, match=rf"{given}' is neither.*mean {meant}"):
        Device.load(given)


def test_names_like_none_are_answered_with_all():
    with pytest.raises(TableError, match="itl_sta3800c_60") as caught:
        DistortionTable.load("teledyne")
    assert "did you mean" not in str(caught.value)
