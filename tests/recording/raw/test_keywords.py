"""Header keywords: first hit, units, signs, overrides; nothing guessed."""

import pytest

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.keywords import (
    amplifier_quantity,
    kind_in_name,
    parse_overrides,
    translate,
)
from bfsensor.recording.raw.sections import layout_of, parse_section


def said(cards, overrides=None, units=None):
    return translate(
        cards, overrides=parse_overrides("x", overrides or {}), card_units=units
    )


def test_the_first_keyword_wins():
    cards = {"DARKTIME": 3.0, "EXPTIME": 2.0, "V_BSS": -70, "IMGTYPE": "FLAT"}
    found, problems = said(cards)
    assert (found["exposure_time"], found["back_bias"], problems) == (2.0, -70.0, ())
    found, _ = said(cards, {"exposure_time": "DARKTIME"})
    assert found["exposure_time"] == 3.0


@pytest.mark.parametrize(
    ("cards", "kind"),
    [
        ({"IMGTYPE": "BIAS", "TESTTYPE": "FLAT"}, "bias"),
        ({"IMGTYPE": "FLAT", "TESTTYPE": "SFLAT"}, "sflat"),
        ({"OBSTYPE": "OBJECT", "TESTTYPE": "SPOT"}, "spot"),
        ({"IMAGETYP": "zero"}, "bias"),
        ({"TESTTYPE": "FE55"}, "fe55"),
        ({"IMAGETYP": "Light Frame"}, "light"),
    ],
)
def test_kinds(cards, kind):
    assert said(cards)[0]["kind"] == kind


def test_units_of_overrides_and_of_comments():
    cards = {"IMGTYPE": "FLAT", "EXPTIME": 1500.0, "VBB": 60.0, "CCDTEMP": 173.0}
    found, problems = said(
        cards,
        {
            "exposure_time": {"unit": "ms"}, "back_bias": {"scale": -1},
            "temperature": {"unit": "K"},
        },
    )  # fmt: skip
    assert (found["exposure_time"], found["back_bias"]) == (1.5, -60.0)
    assert (found["temperature"], problems) == (173.0, ())
    found, _ = said({"IMGTYPE": "FLAT", "MONOWL": 6200}, units={"MONOWL": "Angstrom"})
    assert found["wavelength"] == pytest.approx(620.0)
    found, _ = said({"IMGTYPE": "FLAT"}, {"wavelength": {"value": 550}})
    assert found["wavelength"] == 550.0


@pytest.mark.parametrize(
    ("cards", "name", "words"),
    [
        ({"CCDTEMP": 173.0}, "temperature", "keywords: {temperature: {unit: K}}"),
        ({"MONOWL": 6200}, "wavelength", "{unit: Angstrom}"),
        ({"VBB": -60000.0}, "back_bias", "{unit: mV}"),
        ({"EXPTIME": "long"}, "exposure_time", "EXPTIME = 'long' is not a number"),
        ({"EXPTIME": -1.0}, "exposure_time", "EXPTIME = -1.0 s"),
        ({"SEQNUM": "inf"}, "number", "SEQNUM = inf is not finite"),
        ({"SEQNUM": "first"}, "number", "SEQNUM = 'first' is not a number"),
    ],
)
def test_what_cannot_be_meant_is_not_known(cards, name, words):
    found, problems = said({"IMGTYPE": "FLAT", **cards})
    assert found[name] is None
    assert len(problems) == 1 and words in problems[0]


def test_a_word_where_a_number_is_meant_is_passed_over():
    cards = {"IMGTYPE": "FLAT", "EXPTIME": "long", "DARKTIME": 2.5}
    found, problems = said(cards)
    assert (found["exposure_time"], problems) == (2.5, ())


@pytest.mark.parametrize(
    ("own", "primary", "stated", "keywords", "gain"),
    [
        ({}, {"CCDGAIN": 2.2}, None, {}, 2.2),
        ({"GAIN": 2.1}, {"CCDGAIN": 2.2}, None, {}, 2.1),  # each amplifier's own
        ({"GAIN": 2.1, "CCDGAIN": 2.3}, {}, None, {}, 2.3),
        ({"GAIN": 100, "EGAIN": 0.25}, {}, None, {}, 0.25),  # GAIN is a camera's setting
        ({"GAIN": True, "E-GAIN": 0.46}, {}, None, {}, 0.46),
        ({"GAIN": "HIGH"}, {"GAIN": "1.5"}, None, {}, 1.5),
        ({"GAIN": " "}, {"gain": 1.6}, None, {}, 1.6),
        ({"GAIN": 2.1}, {"MINE": 1.7}, None, {"keyword": "MINE"}, 1.7),
        ({"GAIN": 2.1}, {}, None, {"scale": 2}, 4.2),
        ({"GAIN": 2.1}, {}, None, {"value": 1.8}, 1.8),
        ({"GAIN": 2.1}, {"MINE": 1.7}, 1.9, {"value": 1.8, "scale": 2}, 1.9),
        ({}, {}, None, {}, None),
    ],
)
def test_which_gain_counts(own, primary, stated, keywords, gain):
    overrides = parse_overrides("x", {"gain": keywords} if keywords else {})
    found = amplifier_quantity("gain", own, primary, stated=stated, overrides=overrides)
    assert found == (gain, "")


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0, "GAIN = 0 is out of range (gain: 0.0001 to 10000 e-/ADU)"),
        (-1.5, "GAIN = -1.5"),
        (2e4, "GAIN = 20000.0"),
        ("nan", "GAIN = nan is not finite"),
        ("LOW", "GAIN = 'LOW' is not a number"),
        (False, "GAIN = False is not a number"),
    ],
)
def test_what_is_no_gain_is_not_known(value, words):
    gain, problem = amplifier_quantity("gain", {"GAIN": value}, {})
    assert gain is None and problem.startswith(words)
    # An implausible number is no setting: what the primary header has is not taken for it.
    gain, _ = amplifier_quantity("gain", {"GAIN": value}, {"EGAIN": 2.0})
    assert gain == (2.0 if "number" in words else None)


def test_saturation_of_nothing():
    for value in (0, -1.0):
        assert amplifier_quantity("saturation", {"SATURATE": value}, {}) == (None, "")
    assert amplifier_quantity("saturation", {"SATLEVEL": 6e4}, {}) == (6e4, "")
    noise, problem = amplifier_quantity("noise", {"RDNOISE": -3}, {})
    assert noise is None and problem.startswith("RDNOISE = -3")
    gain, problem = amplifier_quantity("gain", {}, {}, stated="much")
    assert gain is None and "campaign.yaml" in problem and "'much'" in problem


def test_times():
    for cards in (
        {"MJD-OBS": 58603.5},
        {"DATE-OBS": "2019-04-30T12:00:00"},
        {"DATE-OBS": "2019-04-30", "TIME-OBS": "12:00:00"},
    ):
        assert said(cards)[0]["mjd"] == pytest.approx(58603.5)
    assert said({"DATE-OBS": "2019-04-30"})[0]["mjd"] is None


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"exposure": "T"}, "'exposure' is not one of kind"),
        ({"exposure_time": {"unit": "V"}}, "unit 'V' does not convert to s"),
        ({"exposure_time": {"factor": 2}}, "must be a keyword"),
        ({"back_bias": {"scale": "minus"}}, "is not a number"),
        ({"exposure_time": {"scale": float("inf")}}, "scale = inf is not a number"),
    ],
)
def test_wrong_overrides_are_refused(entries, words):
    with pytest.raises(RecordingError, match=r"campaign\.yaml: keywords") as caught:
        parse_overrides("campaign.yaml", entries)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("flat29.5(2).FIT", "flat"),
        ("slitview.00000352.BIAS.FIT", "bias"),
        ("flatbias.fits", None),
        ("bias_flat.fits", None),
        ("spots_3.fits", "spot"),
    ],
)
def test_kinds_in_names(name, kind):
    assert kind_in_name(name) == kind


def test_sections_in_readout_order():
    """Two amplifiers in one image, the right one stored as the sensor lies."""
    left = layout_of(
        "x", "A", 0, (10, 50),
        {"WINDOW": "[1:25,1:10]", "DATASEC": "[3:20,1:8]", "BIASSEC": "[21:25,1:10]",
         "DETSEC": "[1:18,1:8]"},
    )  # fmt: skip
    right = layout_of(
        "x", "B", 0, (10, 50),
        {"WINDOW": "[26:50,1:10]", "DATASEC": "[48:31,1:8]", "BIASSEC": "[26:30,1:10]",
         "DETSEC": "[36:19,1:8]"},
    )  # fmt: skip
    assert left.data == right.data == (slice(0, 8), slice(2, 20))
    assert left.bias == right.bias == (slice(0, 10), slice(20, 25))
    assert (right.stored_flip_x, right.flip_x, left.flip_x) == (True, True, False)
    assert (left.serial_overscan, left.parallel_overscan, left.prescan) == (5, 2, 2)
    assert (left.origin, right.origin) == ((0, 0), (18, 0))


def test_binned_sections():
    cards = {"DATASEC": "[1:9,1:4]", "DETSEC": "[37:20,1:8]", "CCDSUM": "2 2"}
    found = layout_of("x", "A", 0, (4, 9), cards)
    assert (found.origin, found.on_sensor, found.binning) == ((9, 0), (4, 9), (2, 2))


def test_sections_that_fit_with_the_axes_exchanged():
    with pytest.raises(RecordingError, match="with x and y exchanged it would fit"):
        layout_of("x", "A", 0, (10, 20), {"DATASEC": "[1:10,1:20]"})
    for text in ("[1:2]", "[0:3,1:2]", "all"):
        with pytest.raises(RecordingError, match=r"is not like|begins below 1"):
            parse_section(text, "DATASEC")
