"""What header keywords mean: the first hit wins, units and signs are made one.

The table follows the keywords of NOAO, of LSST's test stands (eotest), of LSST's cameras and of
SBIG's proposal for FITS extensions.  A campaign's ``keywords:`` entry puts its own before these.
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
    # Where SBIG's EGAIN [e-/ADU] stands beside GAIN, GAIN is the camera's setting.  Beyond the
    # limits 16 bits would span less than 7 or more than 6e8 electrons.
    "gain": Meaning(("CCDGAIN", "EGAIN", "E-GAIN", "GAIN"), "", "", 1e-4, 1e4),
    "noise": Meaning(("CCDNOISE", "RDNOISE", "READNOIS"), "", "", 0.0, 1e5),
    "saturation": Meaning(("SATURATE", "SATLEVEL"), "", "", 0.0, np.inf),
}  # fmt: skip
"""Section 5 of the format of campaigns; exposure time and temperature also as older cameras
write them.  The lamp is taken as it is: only its ratios are used."""

WORDS = ("kind", "test", "filter")
"""Quantities that are words; the others are numbers."""

AMPLIFIER_UNITS = {"gain": "e-/ADU", "noise": "e-", "saturation": "ADU"}
"""Quantities that each amplifier has of its own, with the units that they are in."""

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
        Named in errors.
    entries : mapping
        By quantity: a keyword, a list of them, or a mapping with ``keyword``, ``unit``,
        ``scale`` or ``value``; of kind, test and filter, ``values``: a mapping of the words of
        headers to those that they stand for, ``{offset: bias, flatfield: flat}``.

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
            "keyword", "unit", "scale", "value", "values"
        }:  # fmt: skip
            raise RecordingError(
                f"{where}: keywords: {name} = {entry!r} must be a keyword, a list of them, or "
                "a mapping with keyword, unit, scale, value, values"
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
            scale = np.nan
        if not np.isfinite(scale):
            raise RecordingError(
                f"{where}: keywords: {name}: scale = {entry['scale']!r} is not a number"
            )
        values = _word_map(where, name, entry.get("values"))
        out[name] = Override(words, unit, scale, entry.get("value"), values)
    return out


def _word_map(where: str, name: str, given: Any) -> tuple[tuple[str, str], ...]:
    """Check the ``values`` of a quantity: words of headers to words that are understood."""
    if given is None:
        return ()
    if name not in WORDS or not isinstance(given, Mapping):
        raise RecordingError(
            f"{where}: keywords: {name}: values = {given!r} must be a mapping such as "
            f"{{offset: bias}}, and of {', '.join(WORDS)} only"
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
    return f"these are, in any case: {', '.join(KINDS)}"


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
        A key for 'mjd' and for each of :data:`MEANINGS` that an exposure has as a whole (not
        :data:`AMPLIFIER_UNITS`); None where the header says nothing or what cannot be meant.
        Exposure time [s], wavelength [nm], temperature [K], voltages [V], lamp as it is.
    problems : tuple of str
        Values that cannot be meant, and what they may be.

    Examples
    --------
    >>> found, problems = translate({"IMGTYPE": "Flat", "EXPTIME": 2, "CCDTEMP": -100.0})
    >>> found["kind"], found["exposure_time"], round(found["temperature"], 2)
    ('flat', 2.0, 173.15)
    """
    given = _capitals(cards)
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
    """Find the gain, noise or saturation of one amplifier: every reader's only way to it.

    Parameters
    ----------
    name : str
        One of :data:`AMPLIFIER_UNITS`.
    own, primary : mapping of str to value
        Cards of the amplifier's extension and of the primary header.
    stated : object, optional
        What campaign.yaml says of this amplifier.
    overrides : mapping of str to Override, optional
        The ``keywords:`` of campaign.yaml.

    Returns
    -------
    value : float or None
        Gain [e-/ADU], noise [e-] or saturation [ADU]; None where it is not known.
    problem : str
        What is wrong with the value that was found; '' where there is none or it is good.

    Notes
    -----
    In this order: campaign.yaml's entry for the amplifier; its ``value`` for all; its keywords;
    then those of :data:`MEANINGS`, all of them in the amplifier's extension first, where NOAO
    and LSST keep the gain of each amplifier, then in the primary header, which may hold a
    nominal one.  The first number decides: one that cannot be meant, such as a gain of 0, is
    no reason to try the next keyword.  A card that holds a word or a logical value, such as
    GAIN = 'HIGH', is a setting and says nothing.  A saturation of 0 or less, which some
    cameras write where they know none, is not one.

    Examples
    --------
    >>> amplifier_quantity("gain", {"GAIN": 2.1}, {"CCDGAIN": 2.2})
    (2.1, '')
    >>> amplifier_quantity("gain", {"GAIN": 100, "EGAIN": 0.25}, {})
    (0.25, '')
    >>> amplifier_quantity("gain", {"GAIN": 0}, {"EGAIN": 2.0})
    (None, 'GAIN = 0 cannot be meant (gain: 0.0001 to 10000 e-/ADU)')
    """
    if stated is not None:
        key = f"campaign.yaml's {name}"
        return _checked(name, stated, key, "", Override(), MEANINGS[name])
    override = (overrides or {}).get(name) or Override()
    return _look_up(name, (_capitals(own), _capitals(primary)), {}, override)


def kind_in_name(name: str) -> str | None:
    """Give the kind that a file's name says, such as 'flat' for 'Pencil5.FLAT.FIT'.

    Examples
    --------
    >>> kind_in_name("bias3.FIT"), kind_in_name("unbiased.fits")
    ('bias', None)
    """
    found = {KINDS[word] for word in _IN_NAMES.findall(name.lower())}
    return found.pop() if len(found) == 1 else None


def _capitals(cards: Mapping[str, Any]) -> dict[str, Any]:
    """Cards with their keywords in capitals."""
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
    """Whether a card holds a number, be it between quotes; logical values are none."""
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
    """Convert one value; None, and what is wrong with it, where it cannot be meant."""
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
            return None, f"{key} = {value} cannot be meant ({name}: {allowed})"
        others = _other_units(name, number, meaning)
        return None, f"{key} = {value} cannot be meant in {unit or 'this'}{others}"
    return number_in_unit, ""


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


def _kind_of(kind: str | None, test: str | None) -> tuple[str | None, bool]:
    """Kind of an exposure, and whether it was understood: the test may say more than 'flat'."""
    said = KINDS.get((kind or "").lower())
    more = KINDS.get((test or "").lower())
    if said in (None, "light", "flat") and more in _SAYS_MORE:
        return more, True
    if said == "light" and more in ("flat", "dark", "bias"):
        return more, True
    return said, said is not None or not kind


def _not_a_kind(said: str, given: Mapping[str, Any], override: Override | None) -> str:
    """Say which word of the header was not understood as a kind, and how to explain it."""
    keywords = (*(override.keywords if override else ()), *MEANINGS["kind"].keywords)
    capitals = (keyword.upper() for keyword in keywords)
    key = next((key for key in capitals if str(given.get(key, "")).strip()), "kind")
    return (
        f"{key} = {said!r} is not understood as a kind of exposure; {_known_kinds()}; say which it "
        f"is in campaign.yaml: keywords: {{kind: {{keyword: {key}, values: {{{said}: flat}}}}}}"
    )


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
