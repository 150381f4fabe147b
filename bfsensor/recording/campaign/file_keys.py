"""Keys of campaign.yaml and columns of manifest.ecsv: meaning, unit, allowed values, example."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bfsensor.recording.campaign.manifest import COLUMNS
from bfsensor.recording.campaign.settings import SCHEMA
from bfsensor.recording.raw.keywords import AMPLIFIER_UNITS, KINDS, MEANINGS, WORDS

_SECTION = "a FITS section of the stored image, such as '[57:1080,51:4146]'"


@dataclass(frozen=True)
class FileKey:
    """One entry of a file that describes a campaign.

    Attributes
    ----------
    key : str
        Its name; a dot leads into a mapping, ``[]`` into the entries of a list.
    unit : str
        Unit of its value; '' for words and plain numbers.
    allowed : str
        Values that are accepted.
    meaning : str
        What it states, and what holds without it.
    example : str
        One line of YAML that states it; '' in a manifest.
    """

    key: str
    unit: str
    allowed: str
    meaning: str
    example: str = ""


CAMPAIGN_KEYS = (
    FileKey("schema", "", f"'{SCHEMA}'", "Version of this format; optional.", f"schema: {SCHEMA}"),
    FileKey("name", "", "text", "Name of the campaign in reports; else that of the folder.",
            "name: run_12"),
    FileKey("sensor", "", "text", "Sensor that was recorded.", "sensor: ITL STA3800C"),
    FileKey("instrument", "", "text", "Another word for `sensor`, used where that is missing.",
            "instrument: SBIG ST-7"),
    FileKey("manifest", "", "a file of the folder",
            "List of the exposures; else manifest.ecsv where there is one.",
            "manifest: exposures.ecsv"),
    FileKey("device_card", "", "a JSON file of the folder",
            "Nominal values and uncertainties of the sensor's quantities, for a baseline that is a "
            "file of edge displacements.", "device_card: device_card.json"),
    FileKey("baseline", "", "a file of the folder, or a built-in device",
            "Simulation that `bfsensor diagnose` compares with; `--baseline` overrides it.",
            "baseline: itl_sta3800c"),
    FileKey("lamp_monitor.keyword", "", "a header keyword",
            "Keyword of the reading of the lamp monitor; only ratios of readings are used.",
            "lamp_monitor: {keyword: DIODE}"),
    FileKey("lamp_monitor.relative_error", "", "above 0",
            "Standard error of one reading of the lamp monitor over the reading.",
            "lamp_monitor: {relative_error: 2.0e-4}"),
    FileKey("spots.grid_px", "pixel", "above 0",
            "Pitch of the mask of spots; it is kept with the campaign and no analysis needs it.",
            "spots: {grid_px: 65}"),
    FileKey("keywords.QUANTITY", "", "a header keyword, or a list of them in the order of trial",
            "Where headers keep a quantity of the table below, tried before the built-in keywords.",
            "keywords: {exposure_time: TEXP}"),
    FileKey("keywords.QUANTITY.keyword", "", "a header keyword, or a list of them",
            "The same, beside the entries that follow.",
            "keywords: {exposure_time: {keyword: [TEXP, TSHUT]}}"),
    FileKey("keywords.QUANTITY.unit", "", "a unit that converts to the quantity's",
            "Unit of the header's number, and of a manifest's column without a unit.",
            "keywords: {exposure_time: {keyword: TEXP, unit: ms}}"),
    FileKey("keywords.QUANTITY.scale", "", "a number",
            "Factor on the header's number, such as -1 where the sign is the other one.",
            "keywords: {back_bias: {scale: -1}}"),
    FileKey("keywords.QUANTITY.value", "the quantity's", "a number or a text",
            "Value of every exposure, whatever headers and manifest state.",
            "keywords: {wavelength: {value: 550}}"),
    FileKey("keywords.QUANTITY.values", "",
            f"a mapping of words to words, for {', '.join(WORDS)} only",
            "Words of the headers, and the words that they stand for.",
            "keywords: {kind: {values: {offset: bias, flatfield: flat}}}"),
    FileKey("amplifiers[].name", "", "a text, different for each",
            "Name of the amplifier: EXTNAME of its extension where it has one; required.",
            "amplifiers: [{name: A}]"),
    FileKey("amplifiers[].hdu", "", "a whole number from 0",
            "Number of the extension that holds its pixels; else the one of that name, else the "
            "first image.", "amplifiers: [{name: A, hdu: 1}]"),
    FileKey("amplifiers[].window", "", _SECTION,
            "Part of the stored image that this amplifier read; else all of it.",
            "amplifiers: [{name: A, window: '[1:1080,1:4146]'}]"),
    FileKey("amplifiers[].data", "", _SECTION, "Pixels that saw light, in place of DATASEC.",
            "amplifiers: [{name: A, data: '[57:1080,51:4146]'}]"),
    FileKey("amplifiers[].bias", "", _SECTION, "Overscan, in place of BIASSEC.",
            "amplifiers: [{name: A, bias: '[7:56,51:4146]'}]"),
    FileKey("amplifiers[].detector", "", "a FITS section of the sensor",
            "Where these pixels lie on the sensor, in place of DETSEC; an axis runs backwards "
            "where the sensor's coordinate falls in readout order.",
            "amplifiers: [{name: A, detector: '[2048:1025,1:4096]'}]"),
    FileKey("amplifiers[].gain", AMPLIFIER_UNITS["gain"],
            f"{MEANINGS['gain'].low:g} to {MEANINGS['gain'].high:g}",
            "Gain, in place of the header's.", "amplifiers: [{name: A, gain: 1.6}]"),
    FileKey("amplifiers[].noise", AMPLIFIER_UNITS["noise"],
            f"{MEANINGS['noise'].low:g} to {MEANINGS['noise'].high:g}",
            "Read noise, in place of the header's.", "amplifiers: [{name: A, noise: 6}]"),
    FileKey("amplifiers[].saturation", AMPLIFIER_UNITS["saturation"], "above 0",
            "Code at which the converter or the pixels saturate, in place of the header's.",
            "amplifiers: [{name: A, saturation: 65535}]"),
    FileKey("masks", "", "a list of FITS sections of the sensor, or of FITS images of it",
            "Pixels that are left out; in an image those that are not 0.",
            "masks: ['[1:2,1:495]', bad.fits]"),
    FileKey("excluded", "", "a list of file names or patterns, or a mapping of them to reasons",
            "Files that are left out; reports quote the reason.",
            "excluded: {'flat_0012*': shutter stuck}"),
    FileKey("pairs.tolerance", "", "above 0",
            "Relative difference of the light (exposure time, times the lamp monitor where there "
            "is one) up to which two flats make a pair; 0.05 without it.", "pairs: {tolerance: 0.02}"),
    FileKey("nuisances", "", "a mapping",
            "Remarks of who made the campaign; it is kept and not interpreted.",
            "nuisances: {shutter: electronic}"),
)  # fmt: skip
"""Keys of campaign.yaml, every one optional."""

QUANTITY_MEANINGS = {
    "kind": f"Kind of the exposure; understood words are {', '.join(KINDS)}.",
    "test": "Name of the test that the exposure belongs to; it refines the kind.",
    "number": "Number of the exposure, in the order of time.",
    "exposure_time": "Commanded exposure time.",
    "wavelength": "Wavelength of the light.",
    "filter": "Name of the filter.",
    "temperature": "Temperature of the sensor.",
    "back_bias": "Back bias.",
    "gate_high": "Voltage of the collecting gates.",
    "gate_low": "Voltage of the barrier gates.",
    "lamp": "Reading of the lamp monitor; only ratios of readings are used.",
    "gain": "Gain of the amplifier.",
    "noise": "Read noise of the amplifier.",
    "saturation": "Code at which the amplifier saturates.",
}
"""Meaning of each quantity that headers and manifests state."""

_COLUMN_MEANINGS = {
    "file": "Name of the file in the folder; required.",
    "mjd": "Modified Julian date of the start of the exposure.",
    "pair": "The two flats of a pair have the same number or word here.",
    "sha256": "SHA-256 sum of the file; a file with another sum is set aside.",
}


@dataclass(frozen=True)
class HeaderQuantity:
    """A quantity of exposures or amplifiers and the header keywords that state it.

    Attributes
    ----------
    name : str
        Its name in ``keywords:`` of campaign.yaml.
    unit : str
        Unit inside the package.
    header_unit : str
        Unit of the header's number where the keyword's comment states none.
    allowed : str
        Range of values that are accepted; one outside it counts as not stated.
    keywords : tuple of str
        Keywords in the order of trial.
    meaning : str
        What it states.
    """

    name: str
    unit: str
    header_unit: str
    allowed: str
    keywords: tuple[str, ...]
    meaning: str


def header_quantities() -> tuple[HeaderQuantity, ...]:
    """List the quantities that are read from headers.

    Returns
    -------
    quantities : tuple of HeaderQuantity

    Examples
    --------
    >>> {q.name: q.unit for q in header_quantities()}["wavelength"]
    'nm'
    """
    return tuple(
        HeaderQuantity(
            name, one.unit or AMPLIFIER_UNITS.get(name, ""), one.header_unit,
            "text" if name in WORDS else _range(one.low, one.high), one.keywords,
            QUANTITY_MEANINGS[name],
        )
        for name, one in MEANINGS.items()
    )  # fmt: skip


def manifest_columns() -> tuple[FileKey, ...]:
    """List the columns of manifest.ecsv, each with the other names that are read alike.

    Returns
    -------
    columns : tuple of FileKey

    Examples
    --------
    >>> manifest_columns()[0].key
    'file, filename, path'
    """
    return tuple(
        FileKey(
            ", ".join(words), MEANINGS[name].header_unit if name in MEANINGS else "",
            _allowed(name),
            QUANTITY_MEANINGS.get(name) or _COLUMN_MEANINGS[name],
        )
        for name, words in COLUMNS.items()
    )  # fmt: skip


def _allowed(name: str) -> str:
    """Values that a column of a manifest accepts."""
    if name in MEANINGS and name not in WORDS:
        # The range is that of the converted value.
        found = _range(MEANINGS[name].low, MEANINGS[name].high)
        same = MEANINGS[name].unit == MEANINGS[name].header_unit
        return found if same or found == "a number" else f"{found} {MEANINGS[name].unit}"
    return "a number" if name == "mjd" else "text"


def _range(low: float, high: float) -> str:
    """Range of numbers in words."""
    if np.isfinite(low) and np.isfinite(high):
        return f"{low:g} to {high:g}"
    return f"at least {low:g}" if np.isfinite(low) else "a number"
