"""What header keywords mean: the first hit wins, units and signs are made one.

The table follows the keywords of NOAO, of LSST's test stands (eotest) and of LSST's cameras.
A campaign's ``keywords:`` entry puts its own before these.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.time import Time

from bfsensor.errors import RecordingError


@dataclass(frozen=True)
class Meaning:
    """One quantity and where headers keep it.

    Attributes
    ----------
    keywords : tuple of str
        In the order in which they are tried.
    unit : str
        Of the value that comes out; '' for words and plain numbers.
    header_unit : str
        What the header's number is in, unless the card's comment begins with a unit in
        brackets, as FITS recommends.
    low, high : float
        Range of values that can be meant, in ``unit``.
    closes : str
        The question that cannot be answered without it; '' where none.
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
        "pairs of flats cannot be found, nor nonlinearity be told from the lamp",
    ),
    "wavelength": Meaning(
        ("MONOWL",), "nm", "nm", 100.0, 3000.0,
        "a chromatic effect cannot be told from the strength of the brighter-fatter effect",
    ),
    "filter": Meaning(("FILTER", "FILTER1")),
    "temperature": Meaning(
        ("CCDTEMP", "CCD-TEMP", "TEMPERAT", "TEMP_SET"), "K", "deg_C", 1.0, 373.0,
        "diffusion cannot be told from the optics, nor gain drift from the lamp's",
    ),
    "back_bias": Meaning(
        ("VBB", "V_BSS"), "V", "V", -1000.0, 1000.0,
        "errors of the device (thickness, doping) cannot be told from missing physics",
    ),
    "gate_high": Meaning(
        ("PARLHI", "V_P1H"), "V", "V", -100.0, 100.0,
        "the storage height and free holes cannot be told from other asymmetries of x and y",
    ),
    "gate_low": Meaning(("PARLLO", "V_P1L"), "V", "V", -100.0, 100.0),
    "lamp": Meaning(
        ("MONDIODE",), "", "", 0.0, np.inf,
        "charge loss and gain nonlinearity cannot be told apart, nor either from the lamp",
    ),
    "gain": Meaning(("CCDGAIN", "GAIN", "E-GAIN", "EGAIN"), "", "", 0.0, 1e4),
    "noise": Meaning(("CCDNOISE", "RDNOISE", "READNOIS"), "", "", 0.0, 1e5),
    "saturation": Meaning(("SATURATE", "SATLEVEL"), "", "", 0.0, np.inf),
}  # fmt: skip
"""Section 5 of the format of campaigns; exposure time and temperature also as older cameras
write them.  The lamp is taken as it is: only its ratios are used."""

TIMES = ("MJD-OBS", "MJD", "MJD-BEG")
DATES = ("DATE-OBS", "DATE-BEG")
CLOCKS = ("TIME-OBS", "UTSTART", "UT")

KINDS = {
    "bias": "bias", "zero": "bias", "dark": "dark", "flat": "flat", "dflat": "flat",
    "domeflat": "flat", "dome flat": "flat", "flat field": "flat", "bias frame": "bias",
    "dark frame": "dark", "light frame": "light", "ptc": "flat", "sflat": "sflat",
    "superflat": "sflat", "spot": "spot", "spots": "spot", "qe": "qe", "lambda": "qe",
    "ppump": "ppump", "fe55": "fe55", "obs": "light", "object": "light", "light": "light",
    "exp": "light", "science": "light",
}  # fmt: skip
"""Kinds by the words of headers; 'light' says no more than that there was some."""

_SAYS_MORE = ("sflat", "spot", "qe", "ppump", "fe55")
_IN_NAMES = re.compile(r"(?:^|[^a-z])(bias|zero|dark|sflat|flat|spot|fe55)s?(?![a-z])")


@dataclass(frozen=True)
class Override:
    """One entry of ``keywords:`` in a campaign.yaml.

    Attributes
    ----------
    keywords : tuple of str
        Tried before the table's.
    unit : str
        What the numbers of headers, and of a manifest's column without a unit, are in; '' as
        the table says.
    scale : float
        These numbers are multiplied by it, such as -1 for a sign.
    value : object
        The same for every exposure, whatever headers say; None for what they say.
    """

    keywords: tuple[str, ...] = ()
    unit: str = ""
    scale: float = 1.0
    value: Any = None


def parse_overrides(where: str, entries: Mapping[str, Any] | None) -> dict[str, Override]:
    """Check the ``keywords:`` of a campaign.yaml.

    Parameters
    ----------
    where : str
        Named in errors.
    entries : mapping
        By quantity: a keyword, a list of them, or a mapping with ``keyword``, ``unit``,
        ``scale`` or ``value``.

    Returns
    -------
    overrides : dict of str to Override

    Raises
    ------
    RecordingError
        A quantity or entry that is not known, a unit that does not convert.

    Examples
    --------
    >>> parse_overrides("x", {"exposure_time": {"keyword": "EXPTIME", "unit": "ms"}})
    {'exposure_time': Override(keywords=('EXPTIME',), unit='ms', scale=1.0, value=None)}
    """
    if not isinstance(entries or {}, Mapping):
        raise RecordingError(f"{where}: keywords must be a mapping, not {entries!r}")
    out: dict[str, Override] = {}
    for name, entry in (entries or {}).items():
        if name not in MEANINGS:
            raise RecordingError(
                f"{where}: keywords: {name!r} is not one of {', '.join(MEANINGS)}"
            )
        if isinstance(entry, str | list):
            entry = {"keyword": entry}
        if not isinstance(entry, Mapping) or set(entry) - {
            "keyword", "unit", "scale", "value"
        }:  # fmt: skip
            raise RecordingError(
                f"{where}: keywords: {name} = {entry!r} must be a keyword, a list of them, or "
                "a mapping with keyword, unit, scale, value"
            )
        words = entry.get("keyword", ())
        words = (words,) if isinstance(words, str) else tuple(str(w) for w in words)
        unit, meaning = str(entry.get("unit", "")), MEANINGS[name]
        if unit and np.isnan(_convert(1.0, unit, meaning.unit)):
            raise RecordingError(
                f"{where}: keywords: {name}: unit {unit!r} does not convert to "
                f"{meaning.unit or 'a plain number'}"
            )
        try:
            scale = float(entry.get("scale", 1.0))
        except (TypeError, ValueError):
            raise RecordingError(
                f"{where}: keywords: {name}: scale = {entry['scale']!r} is not a number"
            ) from None
        out[name] = Override(words, unit, scale, entry.get("value"))
    return out


def header_units(header: fits.Header) -> dict[str, str]:
    """Units that cards give in brackets at the start of their comments, by keyword."""
    out = {}
    for card in header.cards:
        match = re.match(r"\s*\[([^\]]+)\]", card.comment or "")
        if match:
            out[card.keyword] = match.group(1).strip()
    return out


def translate(
    cards: Mapping[str, Any],
    *,
    card_units: Mapping[str, str] | None = None,
    overrides: Mapping[str, Override] | None = None,
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Give what a header says, in the units of this package.

    Parameters
    ----------
    cards : mapping of str to value
        Of the header; case of the keywords does not matter.
    card_units : mapping of str to str, optional
        Units that the cards' comments give.
    overrides : mapping of str to Override, optional

    Returns
    -------
    meaning : dict of str to value
        A key for each of :data:`MEANINGS` and 'mjd'; None where the header says nothing or
        what cannot be meant.  Exposure time [s], wavelength [nm], temperature [K], voltages
        [V], gain [e-/ADU], noise [e-], saturation [ADU], lamp as it is.
    problems : tuple of str
        Values that cannot be meant, and what they may be.

    Examples
    --------
    >>> found, problems = translate({"IMGTYPE": "Flat", "EXPTIME": 2, "CCDTEMP": -100.0})
    >>> found["kind"], found["exposure_time"], round(found["temperature"], 2)
    ('flat', 2.0, 173.15)
    """
    given = {str(key).upper(): value for key, value in cards.items()}
    units = {str(key).upper(): unit for key, unit in (card_units or {}).items()}
    problems: list[str] = []
    found = {
        name: _quantity(name, given, units, (overrides or {}).get(name), problems)
        for name in MEANINGS
    }
    found["kind"], word = _kind_of(found["kind"], found["test"])
    if word:
        problems.append(word)
    if found["kind"] in ("bias", "dark"):
        found.update(dict.fromkeys(("wavelength", "filter", "lamp")))
    found["mjd"] = _mjd_of(given)
    return found, tuple(problems)


def quantity(
    name: str, cards: Mapping[str, Any], overrides: Mapping[str, Override] | None = None
) -> Any:
    """Give one of :data:`MEANINGS` of a header; None where it says nothing usable.

    Examples
    --------
    >>> quantity("gain", {"E-GAIN": 0.46})
    0.46
    """
    given = {str(key).upper(): value for key, value in cards.items()}
    return _quantity(name, given, {}, (overrides or {}).get(name), [])


def kind_in_name(name: str) -> str | None:
    """Give the kind that a file's name says, such as 'flat' for 'Pencil5.FLAT.FIT'.

    Examples
    --------
    >>> kind_in_name("bias3.FIT"), kind_in_name("unbiased.fits")
    ('bias', None)
    """
    found = {KINDS[word] for word in _IN_NAMES.findall(name.lower())}
    return found.pop() if len(found) == 1 else None


def _quantity(
    name: str, given: Mapping[str, Any], units: Mapping[str, str],
    override: Override | None, problems: list[str],
) -> Any:  # fmt: skip
    """Look one quantity up among cards in capitals."""
    meaning, override = MEANINGS[name], override or Override()
    if override.value is not None:
        unit = override.unit or meaning.unit
        return _checked(
            name, override.value, "campaign.yaml", unit, override, meaning, problems
        )
    for keyword in (*override.keywords, *meaning.keywords):
        key = keyword.upper()
        if str(given.get(key, "")).strip():
            unit = override.unit or units.get(key, "") or meaning.header_unit
            return _checked(name, given[key], key, unit, override, meaning, problems)
    return None


def _checked(
    name: str, value: Any, key: str, unit: str, override: Override, meaning: Meaning,
    problems: list[str],
) -> Any:  # fmt: skip
    """Convert one value; None with a problem where it cannot be meant."""
    if name in ("kind", "test", "filter"):
        return str(value).strip()
    try:
        number = float(value)
    except (TypeError, ValueError):
        problems.append(f"{key} = {value!r} is not a number")
        return None
    if name == "number":
        return int(number) if number == int(number) else None
    if not np.isfinite(number):
        problems.append(f"{key} = {value} is not finite")
        return None
    if name == "wavelength" and number == 0:
        return None  # no light, or no monochromator
    if meaning.unit:
        number_in_unit = _convert(number * override.scale, unit, meaning.unit)
        if np.isnan(number_in_unit):
            problems.append(
                f"{key} is in {unit!r}, which does not convert to {meaning.unit}"
            )
            return None
    else:
        number_in_unit = number * override.scale
    if not meaning.low <= number_in_unit <= meaning.high:
        problems.append(f"{key} = {value} cannot be meant in {unit or 'this'}"
                        + _other_units(name, number, meaning))  # fmt: skip
        return None
    return number_in_unit


def _other_units(name: str, number: float, meaning: Meaning) -> str:
    """Name the units in which a number would be possible, and how to say so."""
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
        f" ({' or '.join(fitting)}? say so: keywords: {{{name}: {{unit: {fitting[0]}}}}})"
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


def _kind_of(kind: str | None, test: str | None) -> tuple[str | None, str]:
    """Kind of an exposure and a problem: the test says more than 'flat' or 'object' do."""
    said = KINDS.get((kind or "").lower())
    more = KINDS.get((test or "").lower())
    if said in (None, "light", "flat") and more in _SAYS_MORE:
        return more, ""
    if said == "light" and more in ("flat", "dark", "bias"):
        return more, ""
    if kind and said is None:
        return None, f"kind {kind!r} is not known"
    return said, ""


def _mjd_of(given: Mapping[str, Any]) -> float | None:
    """Time stamp [d]; None where there is none, or a day without a time."""
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
