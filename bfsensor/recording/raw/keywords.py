"""Table of FITS header keywords by quantity, and their translation into the package's units.

The table follows the keywords of NOAO, of LSST's test stands (eotest), of LSST's cameras and of
SBIG's proposal for FITS extensions.  The first keyword found decides.  Keywords in the
``keywords:`` entry of a campaign.yaml are tried before the table's.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.time import Time

from bfsensor.errors import RecordingError, in_one_line


@dataclass(frozen=True)
class Meaning:
    """The header keywords of one quantity, its unit and its possible range.

    Attributes
    ----------
    keywords : tuple of str
        FITS keywords, in the order in which they are tried.
    unit : str
        Unit of the translated value; '' for words and plain numbers.
    header_unit : str
        Unit of the header's number, unless the keyword's comment begins with a unit in
        brackets, as the FITS standard recommends.
    low, high : float
        Smallest and largest possible value, in ``unit``; a number outside is taken as not
        known and reported.
    closes : str
        Analysis that is impossible without the quantity; '' where none.
    """

    keywords: tuple[str, ...]
    unit: str = ""
    header_unit: str = ""
    low: float = -np.inf
    high: float = np.inf
    closes: str = ""


MEANINGS: dict[str, Meaning] = {
    "kind": Meaning(("IMGTYPE", "IMAGETYP", "OBSTYPE", "OBSERVATION_TYPE", "TESTTYPE")),
    "test": Meaning(("TESTTYPE", "REASON", "OBSERVATION_REASON", "SCIENCE_PROGRAM")),
    "number": Meaning(("SEQNUM",)),
    "exposure_time": Meaning(
        ("EXPTIME", "EXPOSURE", "DARKTIME"), "s", "s", 0.0, np.inf,
        "flats cannot be paired, nor nonlinearity be separated from changes of the lamp",
    ),
    "wavelength": Meaning(
        ("MONOWL",), "nm", "nm", 100.0, 3000.0,
        "a chromatic effect cannot be separated from the strength of the brighter-fatter effect",
    ),
    "filter": Meaning(("FILTER", "FILTER1")),
    "temperature": Meaning(
        ("CCDTEMP", "CCD-TEMP", "TEMPERAT", "TEMP_SET"), "K", "deg_C", 1.0, 373.0,
        "diffusion cannot be separated from the optics, nor gain drift from the lamp's",
    ),
    "back_bias": Meaning(
        ("VBB", "V_BSS"), "V", "V", -1000.0, 1000.0,
        "errors of the device (thickness, doping) cannot be separated from missing physics",
    ),
    "gate_high": Meaning(
        ("PARLHI", "V_P1H"), "V", "V", -100.0, 100.0,
        "the depth of the stored charge and free holes cannot be separated from other "
        "asymmetries of x and y",
    ),
    "gate_low": Meaning(("PARLLO", "V_P1L"), "V", "V", -100.0, 100.0),
    "lamp": Meaning(
        ("MONDIODE",), "", "", 0.0, np.inf,
        "charge loss and gain nonlinearity cannot be told apart, nor either from the lamp",
    ),
    # Where SBIG's EGAIN [e-/ADU] stands beside GAIN, GAIN is the camera's setting.  Outside
    # 1e-4 to 1e4 e-/ADU the range of 16 bits would be below 7 or above 6e8 electrons.
    "gain": Meaning(("CCDGAIN", "EGAIN", "E-GAIN", "GAIN"), "", "", 1e-4, 1e4),
    "noise": Meaning(("CCDNOISE", "RDNOISE", "READNOIS"), "", "", 0.0, 1e5),
    "saturation": Meaning(("SATURATE", "SATLEVEL"), "", "", 0.0, np.inf),
}  # fmt: skip
"""Header keywords and possible range of each quantity that a campaign uses.

Exposure time and temperature are also found under the keywords of older cameras.  The lamp
monitor's unit does not matter: only ratios of its readings are used.

The ranges are in the quantity's unit.  Chosen: wide enough for every silicon sensor, and narrow
enough to show another unit.  With upper limits twice as high a wavelength of 5500 Angstrom would
pass as 5500 nm, and a temperature of 173 K, taken as deg C, as 446 K.
"""

WORDS = ("kind", "test", "filter")
"""Quantities that are words; the others are numbers."""

AMPLIFIER_UNITS = {"gain": "e-/ADU", "noise": "e-", "saturation": "ADU"}
"""Unit of each quantity that amplifiers of one exposure have separately."""

TIMES = ("MJD-OBS", "MJD", "MJD-BEG")
"""Keywords of a time stamp as a modified Julian date [d], in the order in which they are tried."""

DATES = ("DATE-OBS", "DATE-BEG")
"""Keywords of a date, with or without the time of day, tried where there is no Julian date."""

CLOCKS = ("TIME-OBS", "UTSTART", "UT")
"""Keywords of the time of day (UT), for a date without one."""

KINDS = {
    "bias": "bias", "zero": "bias", "dark": "dark", "flat": "flat", "dflat": "flat",
    "domeflat": "flat", "dome flat": "flat", "flat field": "flat", "bias frame": "bias",
    "dark frame": "dark", "light frame": "light", "ptc": "flat", "sflat": "sflat",
    "superflat": "sflat", "spot": "spot", "spots": "spot", "qe": "qe", "lambda": "qe",
    "ppump": "ppump", "fe55": "fe55", "obs": "light", "object": "light", "light": "light",
    "exp": "light", "science": "light",
}  # fmt: skip
"""Kind of exposure by the header's word, in small letters; 'light' is any exposure to light."""

_LONGEST_UNIT = 60
"""Largest number of characters of a unit.  Chosen: the longest in use has 8, and astropy takes a
second to refuse one of thousands; with 120 nothing changes."""

_SAYS_MORE = ("sflat", "spot", "qe", "ppump", "fe55")
"""Kinds that a test's name states where the exposure type is only 'flat' or 'light'."""

_IN_NAMES = re.compile(r"(?:^|[^a-z])(bias|zero|dark|sflat|flat|spot|fe55)s?(?![a-z])")


@dataclass(frozen=True)
class Override:
    """One entry of ``keywords:`` in a campaign.yaml.

    Attributes
    ----------
    keywords : tuple of str
        Keywords that are tried before those of :data:`MEANINGS`.
    unit : str
        Unit of the header's number, of ``value``, and of a manifest's column without a unit; ''
        for the unit of :data:`MEANINGS`.
    scale : float
        Factor that these numbers are multiplied by, such as -1 for a sign.
    value : object
        Value of every exposure, whatever the headers say; None to use the headers.
    values : tuple of (str, str)
        Words of headers, in small letters, and the words that they stand for.
    """

    keywords: tuple[str, ...] = ()
    unit: str = ""
    scale: float = 1.0
    value: Any = None
    values: tuple[tuple[str, str], ...] = field(default=(), repr=False)


def parse_overrides(where: str, entries: Mapping[str, Any] | None) -> dict[str, Override]:
    """Check the ``keywords:`` of a campaign.yaml.

    Parameters
    ----------
    where : str
        Name of the file, for errors.
    entries : mapping or None
        For each quantity of :data:`MEANINGS` a keyword, a list of keywords, or a mapping with
        ``keyword``, ``unit``, ``scale`` or ``value``.  Kind, test and filter may also have
        ``values``, a mapping of the header's words to those that they stand for, such as
        ``{offset: bias, flatfield: flat}``.

    Returns
    -------
    overrides : dict of str to Override
        One for each quantity of ``entries``; empty without entries.

    Raises
    ------
    RecordingError
        A quantity or an entry is not known, a unit does not convert, or a scale is no finite
        number.

    Examples
    --------
    >>> parse_overrides("x", {"exposure_time": {"keyword": "EXPTIME", "unit": "ms"}})
    {'exposure_time': Override(keywords=('EXPTIME',), unit='ms', scale=1.0, value=None)}
    """
    if not isinstance(entries or {}, Mapping):
        raise RecordingError(
            f"{where}: keywords must be a mapping of quantities to header keywords, such as "
            f"{{exposure_time: TEXP}}, not {entries!r}"
        )
    out: dict[str, Override] = {}
    for name, entry in (entries or {}).items():
        if name not in MEANINGS:
            raise RecordingError(
                f"{where}: keywords: {name!r} is not one of {', '.join(MEANINGS)}"
            )
        if isinstance(entry, str | list):
            entry = {"keyword": entry}
        if not isinstance(entry, Mapping) or set(entry) - {
            "keyword", "unit", "scale", "value", "values"
        }:  # fmt: skip
            raise RecordingError(
                f"{where}: keywords: {name} = {entry!r} must be a keyword of the headers, a list "
                "of keywords, or a mapping with some of keyword, unit, scale, value, values"
            )
        words = entry.get("keyword", ())
        words = (words,) if isinstance(words, str) else words
        if not isinstance(words, list | tuple) or not all(
            isinstance(w, str) and w for w in words
        ):
            raise RecordingError(
                f"{where}: keywords: {name}: keyword = {words!r} must be a keyword of the headers or a "
                "list of them, as texts"
            )
        words, meaning = tuple(words), MEANINGS[name]
        unit = entry.get("unit", "")
        if not isinstance(unit, str) or len(unit) > _LONGEST_UNIT:
            raise RecordingError(
                f"{where}: keywords: {name}: unit = {unit!r} must be a unit"
            )
        if unit and np.isnan(_convert(1.0, unit, meaning.unit)):
            raise RecordingError(
                f"{where}: keywords: {name}: unit {unit!r} does not convert to "
                f"{meaning.unit or 'a plain number'}"
            )
        try:
            scale = float(entry.get("scale", 1.0))
        except (TypeError, ValueError, OverflowError):
            scale = np.nan
        if not np.isfinite(scale) or scale == 0 or isinstance(entry.get("scale"), bool):
            raise RecordingError(
                f"{where}: keywords: {name}: scale = {in_one_line(repr(entry['scale']), 60)} is not a "
                "number; give a finite one other than 0, such as -1"
            )
        values = _word_map(where, name, entry.get("values"))
        out[name] = Override(words, unit, scale, entry.get("value"), values)
    return out


def _word_map(where: str, name: str, given: Any) -> tuple[tuple[str, str], ...]:
    """Check the ``values`` of a quantity, which map words of headers to known words."""
    if given is None:
        return ()
    if name not in WORDS or not isinstance(given, Mapping):
        raise RecordingError(
            f"{where}: keywords: {name}: values = {given!r} must be a mapping such as "
            f"{{offset: bias}}; only {', '.join(WORDS)} have values"
        )
    if not all(isinstance(word, str) for word in given.values()):
        raise RecordingError(
            f"{where}: keywords: {name}: values = {given!r} must map to texts"
        )
    for word in given.values() if name == "kind" else ():
        if str(word).lower() not in KINDS:
            raise RecordingError(
                f"{where}: keywords: kind: values: {word!r} is not understood; "
                f"{_known_kinds()}"
            )
    return tuple((str(key).strip().lower(), str(word)) for key, word in given.items())


def _known_kinds() -> str:
    """Name the words for kinds of exposures that are understood."""
    return f"words that are, in capitals or small letters: {', '.join(KINDS)}"


def header_units(header: fits.Header) -> dict[str, str]:
    """Units by keyword, where a comment begins with one in brackets, such as '[ms] exposure'."""
    out = {}
    for card in header.cards:
        match = re.match(r"\s*\[([^\]]+)\]", card.comment or "")
        if match:
            out[card.keyword] = match.group(1).strip()
    return out


def translate(
    header: Mapping[str, Any],
    *,
    card_units: Mapping[str, str] | None = None,
    overrides: Mapping[str, Override] | None = None,
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Translate a header into quantities in the units of this package.

    Parameters
    ----------
    header : mapping of str to value
        Values of the header by keyword; case of the keywords does not matter.
    card_units : mapping of str to str, optional
        Units by keyword, as :func:`header_units` finds them.
    overrides : mapping of str to Override, optional
        The ``keywords:`` of campaign.yaml.

    Returns
    -------
    meaning : dict of str to value
        The time stamp 'mjd' [d] and each quantity of :data:`MEANINGS` that an exposure has as
        a whole (not :data:`AMPLIFIER_UNITS`): exposure time [s], wavelength [nm], temperature
        [K], voltages [V], lamp in the header's unit.  None where the header has no value, or
        none within the possible range.
    problems : tuple of str
        Values outside the possible range, each with the unit that would explain it.

    Examples
    --------
    >>> found, problems = translate({"IMGTYPE": "Flat", "EXPTIME": 2, "CCDTEMP": -100.0})
    >>> found["kind"], found["exposure_time"], round(found["temperature"], 2)
    ('flat', 2.0, 173.15)
    """
    given = _capitals(header)
    units = _capitals(card_units or {})
    found: dict[str, Any] = {}
    problems: list[str] = []
    for name in MEANINGS:
        if name not in AMPLIFIER_UNITS:
            override = (overrides or {}).get(name) or Override()
            found[name], problem = _look_up(name, (given,), units, override)
            problems += [problem] if problem else []
    said = found["kind"]
    found["kind"], understood = _kind_of(said, found["test"])
    if not understood:
        problems.append(_not_a_kind(str(said), given, (overrides or {}).get("kind")))
    if found["kind"] in ("bias", "dark"):
        found.update(dict.fromkeys(("wavelength", "filter", "lamp")))
    found["mjd"] = _mjd_of(given)
    return found, tuple(problems)


def amplifier_quantity(
    name: str,
    own: Mapping[str, Any],
    primary: Mapping[str, Any],
    *,
    stated: Any = None,
    overrides: Mapping[str, Override] | None = None,
) -> tuple[float | None, str]:
    """Find the gain, noise or saturation of one amplifier.

    All readers of raw files use this function, so that no two of them disagree.

    Parameters
    ----------
    name : str
        One of :data:`AMPLIFIER_UNITS`.
    own, primary : mapping of str to value
        Values by keyword of the amplifier's extension and of the primary header.
    stated : object, optional
        Value in campaign.yaml's entry for this amplifier.
    overrides : mapping of str to Override, optional
        The ``keywords:`` of campaign.yaml.

    Returns
    -------
    value : float or None
        Gain [e-/ADU], noise [e-] or saturation [ADU]; None where it is not known.
    problem : str
        Why the value that was found cannot be used; '' where none was found or it can.

    Notes
    -----
    Values are searched in this order: campaign.yaml's entry for the amplifier; its ``value``
    for all; its keywords; then those of :data:`MEANINGS`, all of them in the amplifier's
    extension first, where NOAO and LSST keep the gain of each amplifier, then in the primary
    header, which may hold a nominal one.  The first number decides: if it is out of range,
    such as a gain of 0, the next keyword is not tried.  A word or a logical value, such as
    GAIN = 'HIGH', is a camera's setting and is passed over.  A saturation of 0 or less stands
    for one that is not known, as some cameras write it.

    Examples
    --------
    >>> amplifier_quantity("gain", {"GAIN": 2.1}, {"CCDGAIN": 2.2})
    (2.1, '')
    >>> amplifier_quantity("gain", {"GAIN": 100, "EGAIN": 0.25}, {})
    (0.25, '')
    >>> amplifier_quantity("gain", {"GAIN": 0}, {"EGAIN": 2.0})
    (None, 'GAIN = 0 is out of range (gain: 0.0001 to 10000 e-/ADU)')
    """
    if stated is not None:
        key = f"campaign.yaml's {name}"
        return _checked(name, stated, key, "", Override(), MEANINGS[name])
    override = (overrides or {}).get(name) or Override()
    return _look_up(name, (_capitals(own), _capitals(primary)), {}, override)


def kind_in_name(name: str) -> str | None:
    """Give the kind of exposure in a file's name; None where it names none, or several.

    Examples
    --------
    >>> kind_in_name("bias3.FIT"), kind_in_name("unbiased.fits")
    ('bias', None)
    """
    found = {KINDS[word] for word in _IN_NAMES.findall(name.lower())}
    return found.pop() if len(found) == 1 else None


def _capitals(cards: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a header with their keywords in capitals."""
    return {str(key).upper(): value for key, value in cards.items()}


def _look_up(
    name: str, headers: Sequence[Mapping[str, Any]], units: Mapping[str, str],
    override: Override,
) -> tuple[Any, str]:  # fmt: skip
    """Look one quantity up in headers with keywords in capitals, the most specific first."""
    meaning = MEANINGS[name]
    if override.value is not None:
        unit = override.unit or meaning.unit
        key = f"campaign.yaml's {name}"
        return _checked(name, override.value, key, unit, override, meaning)
    aside = ""
    # campaign.yaml's keywords in every header, then the table's header by header.
    for keywords in (override.keywords, meaning.keywords):
        for given in headers:
            for keyword in keywords:
                key = keyword.upper()
                value = given.get(key, "")
                if not str(value).strip():
                    continue
                if name not in WORDS and not _is_number(value):
                    aside = aside or f"{key} = {value!r} is not a number"
                    continue
                unit = override.unit or units.get(key, "") or meaning.header_unit
                return _checked(name, value, key, unit, override, meaning)
    return None, aside


def _is_number(value: Any) -> bool:
    """Whether a header's value is a number, also between quotes; logical values are none."""
    if isinstance(value, bool):
        return False
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _checked(
    name: str, value: Any, key: str, unit: str, override: Override, meaning: Meaning
) -> tuple[Any, str]:
    """Convert one value; None, and the problem, where it is no number or out of range."""
    if name in WORDS:
        text = str(value).strip()
        return dict(override.values).get(text.lower(), text), ""
    if not _is_number(value):
        return None, f"{key} = {value!r} is not a number"
    number = float(value)
    if not np.isfinite(number):
        return None, f"{key} = {value} is not finite"
    if name == "number":
        return (int(number) if number == int(number) else None), ""
    if name == "saturation" and number <= 0:
        return None, ""
    if name == "wavelength" and number == 0:
        return None, ""  # no light, or no monochromator
    number_in_unit = number * override.scale
    if meaning.unit:
        number_in_unit = _convert(number_in_unit, unit, meaning.unit)
        if np.isnan(number_in_unit):
            return None, f"{key} is in {unit!r}, which does not convert to {meaning.unit}"
    if not meaning.low <= number_in_unit <= meaning.high:
        if name in AMPLIFIER_UNITS:
            allowed = f"{meaning.low:g} to {meaning.high:g} {AMPLIFIER_UNITS[name]}"
            return None, f"{key} = {value} is out of range ({name}: {allowed})"
        others = _other_units(name, number, meaning)
        there = f"{meaning.low:g} to {meaning.high:g} {meaning.unit}".strip()
        taken = f"{value} {unit}".strip()
        return None, f"{key} = {taken} is out of range ({name}: {there}){others}"
    return number_in_unit, ""


def _other_units(name: str, number: float, meaning: Meaning) -> str:
    """Name the units in which a number would be possible, and the entry that states one."""
    tried = {"wavelength": ("Angstrom", "um"), "temperature": ("K",),
             "back_bias": ("mV",), "gate_high": ("mV",), "gate_low": ("mV",)}  # fmt: skip
    fitting = [
        unit
        for unit in tried.get(name, ())
        if meaning.low <= _convert(number, unit, meaning.unit) <= meaning.high
    ]
    if not fitting:
        return ""
    return (
        f"; if it is in {' or '.join(fitting)}, state that in campaign.yaml: keywords: "
        f"{{{name}: {{unit: {fitting[0]}}}}}"
    )


def _convert(number: float, unit: str, wanted: str) -> float:
    """Convert a number; nan where the units do not fit."""
    if unit in ("C", "degC", "celsius") and wanted == "K":
        unit = "deg_C"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", u.UnitsWarning)
            given = u.Unit(unit)
            value = (number * given).to_value(wanted, u.temperature())
            return float(f"{value:.12g}")  # 173.15 K, not 173.14999999999998
    except (ValueError, TypeError, u.UnitsError):
        return float("nan")


def _kind_of(kind: str | None, test: str | None) -> tuple[str | None, bool]:
    """Kind of an exposure, and whether it was understood; a test may be more specific."""
    said = KINDS.get((kind or "").lower())
    more = KINDS.get((test or "").lower())
    if said in (None, "light", "flat") and more in _SAYS_MORE:
        return more, True
    if said == "light" and more in ("flat", "dark", "bias"):
        return more, True
    return said, said is not None or not kind


def _not_a_kind(said: str, given: Mapping[str, Any], override: Override | None) -> str:
    """Say which word of the header is no known kind, and how campaign.yaml maps it."""
    keywords = (*(override.keywords if override else ()), *MEANINGS["kind"].keywords)
    capitals = (keyword.upper() for keyword in keywords)
    key = next((key for key in capitals if str(given.get(key, "")).strip()), "kind")
    return (
        f"{key} = {said!r} is not understood as a kind of exposure; {_known_kinds()}; map it in "
        "campaign.yaml to the one that it is, here flat: keywords: "
        f"{{kind: {{keyword: {key}, values: {{{said}: flat}}}}}}"
    )


def _mjd_of(given: Mapping[str, Any]) -> float | None:
    """Time stamp [MJD]; None where there is none, or a date without the time of day."""
    for key in TIMES:
        if isinstance(given.get(key), int | float) and np.isfinite(given[key]):
            return float(given[key])
    for key in DATES:
        day = str(given.get(key, "")).strip()
        clock = next((str(given[c]).strip() for c in CLOCKS if given.get(c)), "")
        stamp = day if "T" in day else f"{day}T{clock}"
        try:
            return float(Time(stamp, format="isot", scale="utc").mjd)
        except ValueError:
            continue
    return None
