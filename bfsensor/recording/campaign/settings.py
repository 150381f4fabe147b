"""The file campaign.yaml: its entries and their checks."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bfsensor.errors import RecordingError, in_one_line
from bfsensor.recording.campaign.exposures import PAIR_TOLERANCE
from bfsensor.recording.raw.headers import SECTION_ENTRIES
from bfsensor.recording.raw.keywords import AMPLIFIER_UNITS, Override, parse_overrides
from bfsensor.text_files import load_yaml, one_line

SCHEMA = "bfsensor-campaign-1"
"""Value of the entry ``schema``; a file with another one is refused."""

NAME = "campaign.yaml"
"""Name of the file in the campaign's folder."""

ENTRIES = (
    "schema", "name", "sensor", "instrument", "manifest", "device_card", "baseline",
    "lamp_monitor", "spots", "keywords", "amplifiers", "masks", "excluded", "pairs",
    "nuisances",
)  # fmt: skip
"""Entries of campaign.yaml, all optional:

- name, sensor, instrument: words;
- manifest, device_card, baseline: files in the folder (a baseline may be a device's name);
- lamp_monitor: ``{keyword: MONDIODE, relative_error: 2e-4}``, the keyword of the lamp monitor and
  the relative error of one reading;
- spots: ``{grid_px: 30}``, the pitch of the mask of spots [pixel];
- keywords: header keywords, see :func:`bfsensor.recording.raw.keywords.parse_overrides`;
- amplifiers: a list of ``{name: A, hdu: 0, window: '[1:1080,1:4146]', data: '[57:1080,51:4146]',
  bias: '[7:56,51:4146]', detector: '[2048:1025,1:4096]', gain: 4.1, noise: 6,
  saturation: 65535}``; sections as in FITS, of the stored image, ``detector`` of the sensor; gain
  [e-/ADU], noise [e-], saturation [ADU];
- masks: sections of the sensor, or FITS images of it, 0 where a pixel is good;
- excluded: names or patterns of files, or a mapping of them to reasons;
- pairs: ``{tolerance: 1e-3}``, the largest relative difference of a pair's exposure times;
- nuisances: a mapping that is kept and not used.
"""

PARTS = {
    "lamp_monitor": ("keyword", "relative_error"), "spots": ("grid_px",), "pairs": ("tolerance",),
}  # fmt: skip
"""Names in the entries that are mappings of a fixed form; others are ignored with a remark."""

LONGEST_NAME = 200
"""Largest number of characters of a name or text in campaign.yaml.  Chosen: file names have at most 255;
with 400 reports would show longer names and nothing else would change."""


@dataclass(frozen=True)
class CampaignSettings:
    """Entries of a campaign.yaml, checked.

    Attributes
    ----------
    name, sensor : str
        Names of the campaign and of the sensor; '' where not given.
    manifest, device_card : Path or None
        Existing files; None where not given.
    baseline : str
        File in the folder, or name of a built-in device; '' where not given.
    lamp_error : float or None
        Relative error of one reading of the lamp monitor; None where not given.
    spot_grid : float or None
        Pitch of the mask of spots [pixel]; None where not given.
    overrides : mapping of str to Override
        The entry ``keywords``, by quantity.
    amplifiers : tuple of mappings
        The entry ``amplifiers``; empty where the headers state the sections.
    masks : tuple of str
        Sections of the sensor, or names of FITS images.
    excluded : mapping of str to str
        Reasons for leaving files out, by pattern of their names.
    pair_tolerance : float
        Largest difference of the light of a pair's flats over the larger one.
    nuisances : mapping
        The entry ``nuisances``, which is not used.
    remarks : tuple of str
        Entries that are not known and were ignored, each in a sentence.
    """

    name: str = ""
    sensor: str = ""
    manifest: Path | None = None
    device_card: Path | None = None
    baseline: str = ""
    lamp_error: float | None = None
    spot_grid: float | None = None
    overrides: Mapping[str, Override] = field(default_factory=dict)
    amplifiers: tuple[Mapping[str, Any], ...] = ()
    masks: tuple[str, ...] = ()
    excluded: Mapping[str, str] = field(default_factory=dict)
    pair_tolerance: float = PAIR_TOLERANCE
    nuisances: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def reason_to_exclude(self, name: str) -> str | None:
        """Give the reason for which campaign.yaml excludes a file; None where it does not."""
        for pattern, reason in self.excluded.items():
            if fnmatch.fnmatch(name, pattern):
                return reason
        return None


def read_settings(folder: Path) -> CampaignSettings:
    """Read the campaign.yaml of a folder; without one all settings have their defaults.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.

    Returns
    -------
    settings : CampaignSettings
        The checked entries.

    Raises
    ------
    RecordingError
        The file is not YAML or of an unknown schema, an entry has the wrong form, or a file that
        it names does not exist.
    """
    path = folder / NAME
    if not path.is_file():
        manifest = folder / "manifest.ecsv"
        return CampaignSettings(manifest=manifest if manifest.is_file() else None)
    try:
        given = load_yaml(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RecordingError(f"{path}: not readable as YAML: {one_line(error)}") from None
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise RecordingError(
            f"{path}: must be a mapping of entries, such as 'name: run 3'; entries are "
            f"{', '.join(ENTRIES)}"
        )
    schema = given.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise RecordingError(
            f"{path}: schema = {schema!r} is not {SCHEMA!r}, the only one that is read"
        )
    unknown = [str(key) for key in given if key not in ENTRIES]
    for name, allowed in PARTS.items():
        unknown += [
            f"{name}: {key}" for key in _mapping(path, given, name) if key not in allowed
        ]
    remarks = [
        f"campaign.yaml: {key} is not known and is ignored; entries are {', '.join(ENTRIES)}"
        for key in unknown
    ]
    lamp = _mapping(path, given, "lamp_monitor")
    overrides = parse_overrides(str(path), given.get("keywords"))
    if keyword := _text(path, lamp, "keyword"):
        overrides.setdefault("lamp", Override((keyword,)))
    return CampaignSettings(
        name=_text(path, given, "name"),
        sensor=_text(path, given, "sensor") or _text(path, given, "instrument"),
        manifest=_file(folder, path, given, "manifest", "manifest.ecsv"),
        device_card=_file(folder, path, given, "device_card", None),
        baseline=_text(path, given, "baseline"),
        lamp_error=_number(path, lamp, "lamp_monitor", "relative_error"),
        spot_grid=_number(path, _mapping(path, given, "spots"), "spots", "grid_px"),
        overrides=overrides,
        amplifiers=_amplifiers(path, given.get("amplifiers")),
        masks=_texts(path, given, "masks"),
        excluded=_excluded(path, given),
        pair_tolerance=_number(path, _mapping(path, given, "pairs"), "pairs", "tolerance")
        or PAIR_TOLERANCE,
        nuisances=_mapping(path, given, "nuisances"),
        remarks=tuple(remarks),
    )


def _mapping(path: Path, given: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = given.get(name) or {}
    if not isinstance(value, Mapping):
        raise RecordingError(f"{path}: {name} = {value!r} must be a mapping")
    return value


def _number(path: Path, given: Mapping[str, Any], entry: str, name: str) -> float | None:
    """Number above 0 of an entry; None where it is not given."""
    value = given.get(name)
    if value is None:
        return None
    try:
        # YAML reads 1e-4, without a decimal point, as a word.
        number = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if not 0 < number < float("inf"):
        raise RecordingError(
            f"{path}: {entry}: {name} = {in_one_line(repr(value), 60)} must be a finite number above 0"
        )
    return number


def _text(path: Path, given: Mapping[str, Any], name: str) -> str:
    """Text of an entry, also one that YAML reads as a number; '' where it is not given."""
    value = given.get(name)
    if value is None:
        return ""
    text = str(value) if isinstance(value, int | float) else value
    if isinstance(value, bool) or not isinstance(text, str) or len(text) > LONGEST_NAME:
        raise RecordingError(
            f"{path}: {name} = {in_one_line(repr(value), 60)} must be a text of at most {LONGEST_NAME} "
            "characters"
        )
    return text


def _file(
    folder: Path, path: Path, given: Mapping[str, Any], name: str, default: str | None
) -> Path | None:
    """Path of the file that an entry names; without the entry the default file, if it exists."""
    value = given.get(name)
    if value is None:
        there = default is not None and (folder / default).is_file()
        return folder / str(default) if there else None
    if not (folder / str(value)).is_file():
        raise RecordingError(
            f"{path}: {name}: {folder / str(value)} is not there; give a file name relative to "
            "the folder"
        )
    return folder / str(value)


def _texts(path: Path, given: Mapping[str, Any], name: str) -> tuple[str, ...]:
    value = given.get(name) or ()
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise RecordingError(
            f"{path}: {name} = {value!r} must be a list of texts, such as ['...', '...']"
        )
    return tuple(value)


def _excluded(path: Path, given: Mapping[str, Any]) -> dict[str, str]:
    value = given.get("excluded") or {}
    if isinstance(value, Mapping):
        return {str(key): f"excluded: {why}" for key, why in value.items()}
    return dict.fromkeys(_texts(path, given, "excluded"), "excluded in campaign.yaml")


def _amplifiers(path: Path, given: Any) -> tuple[Mapping[str, Any], ...]:
    """Check the list of amplifiers; their sections are checked with the files."""
    allowed = {"name", "hdu", *SECTION_ENTRIES, *AMPLIFIER_UNITS}
    if given is None:
        return ()
    if not isinstance(given, list) or not given:
        raise RecordingError(
            f"{path}: amplifiers must be a list of mappings, such as "
            "[{name: A, bias: '[513:540,1:2000]'}]"
        )
    names = []
    for entry in given:
        if not isinstance(entry, Mapping) or "name" not in entry or set(entry) - allowed:
            raise RecordingError(
                f"{path}: amplifiers: {entry!r} must have a name and no entries but "
                f"{', '.join(sorted(allowed))}"
            )
        names.append(_text(path, entry, "name"))
        if not names[-1]:
            raise RecordingError(
                f"{path}: amplifiers: every entry needs a name that is not empty"
            )
        hdu = entry.get("hdu", 0)
        if isinstance(hdu, bool) or not isinstance(hdu, int) or hdu < 0:
            raise RecordingError(
                f"{path}: amplifiers: hdu = {in_one_line(repr(hdu), 60)} must be a whole number from 0"
            )
    if len(set(names)) < len(names):
        raise RecordingError(
            f"{path}: amplifiers: the names {', '.join(names)} must differ from one another"
        )
    return tuple(given)
