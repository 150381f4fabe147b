"""What a campaign.yaml may say: what the headers of a campaign cannot."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.headers import SECTION_ENTRIES
from bfsensor.recording.raw.keywords import AMPLIFIER_UNITS, Override, parse_overrides

SCHEMA = "bfsensor-campaign-1"
NAME = "campaign.yaml"
ENTRIES = (
    "schema", "name", "sensor", "instrument", "manifest", "device_card", "baseline",
    "lamp_monitor", "spots", "keywords", "amplifiers", "masks", "excluded", "pairs",
    "nuisances",
)  # fmt: skip
"""
name, sensor, instrument: words.  manifest, device_card, baseline: files (a baseline may be
a device's name).  lamp_monitor: ``{keyword: MONDIODE, relative_error: 2e-4}``.  spots:
``{grid_px: 30}``.  keywords: see :func:`bfsensor.recording.raw.keywords.parse_overrides`.
amplifiers: a list of ``{name: A, hdu: 0, window: '[1:1080,1:4146]', data: '[57:1080,51:4146]',
bias: '[7:56,51:4146]', detector: '[2048:1025,1:4096]', gain: 4.1, noise: 6, saturation: 65535}``,
sections as in FITS, of the stored image.  masks: sections of the sensor, or FITS
images of it, 0 where good.  excluded: names or patterns of files, or a mapping of them to
reasons.  pairs:
``{tolerance: 1e-3}``, the relative difference of exposure times that still makes a pair.
"""


@dataclass(frozen=True)
class CampaignSettings:
    """A campaign.yaml, checked.

    Attributes
    ----------
    name, sensor : str
        Words; '' where not given.
    manifest, device_card : Path or None
        Files, found.
    baseline : str
        A file in the folder, or a name of one of our devices; '' where not given.
    lamp_error : float or None
        Relative error of one reading of the lamp monitor.
    spot_grid : float or None
        Pitch of the spots' mask [pixel].
    overrides : mapping of str to Override
        Keywords.
    amplifiers : tuple of mappings
        Sections by amplifier; empty where the headers have them.
    masks : tuple of str
        Sections or files.
    excluded : mapping of str to str
        Reasons by pattern.
    pair_tolerance : float
        Relative difference of exposure times.
    nuisances : mapping
        As it is.
    remarks : tuple of str
        What in it was not understood.
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
    pair_tolerance: float = 1e-3
    nuisances: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def reason_to_exclude(self, name: str) -> str | None:
        """Give the reason for which campaign.yaml leaves a file out; None where it does not."""
        for pattern, reason in self.excluded.items():
            if fnmatch.fnmatch(name, pattern):
                return reason
        return None


def read_settings(folder: Path) -> CampaignSettings:
    """Read campaign.yaml; without one, what holds for any folder.

    Parameters
    ----------
    folder : Path
        The campaign.

    Returns
    -------
    CampaignSettings

    Raises
    ------
    RecordingError
        Not YAML, an unknown schema, an entry of the wrong form, or a file that is not there.
    """
    path = folder / NAME
    if not path.is_file():
        manifest = folder / "manifest.ecsv"
        return CampaignSettings(manifest=manifest if manifest.is_file() else None)
    try:
        given = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        line = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: not readable as YAML: {line}") from None
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise RecordingError(f"{path}: must be a mapping of entries")
    schema = given.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise RecordingError(f"{path}: schema = {schema!r} is not {SCHEMA!r}")
    unknown = [str(key) for key in given if key not in ENTRIES]
    remarks = [
        f"campaign.yaml: {key} is not known and was passed over (known: {', '.join(ENTRIES)})"
        for key in unknown
    ]
    lamp = _mapping(path, given, "lamp_monitor")
    overrides = parse_overrides(str(path), given.get("keywords"))
    if lamp.get("keyword"):
        overrides.setdefault("lamp", Override((str(lamp["keyword"]),)))
    return CampaignSettings(
        name=str(given.get("name", "")),
        sensor=str(given.get("sensor", given.get("instrument", ""))),
        manifest=_file(folder, path, given, "manifest", "manifest.ecsv"),
        device_card=_file(folder, path, given, "device_card", None),
        baseline=str(given.get("baseline") or ""),
        lamp_error=_number(path, lamp, "lamp_monitor", "relative_error"),
        spot_grid=_number(path, _mapping(path, given, "spots"), "spots", "grid_px"),
        overrides=overrides,
        amplifiers=_amplifiers(path, given.get("amplifiers")),
        masks=_texts(path, given, "masks"),
        excluded=_excluded(path, given),
        pair_tolerance=_number(path, _mapping(path, given, "pairs"), "pairs", "tolerance")
        or 1e-3,
        nuisances=_mapping(path, given, "nuisances"),
        remarks=tuple(remarks),
    )


def _mapping(path: Path, given: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = given.get(name) or {}
    if not isinstance(value, Mapping):
        raise RecordingError(f"{path}: {name} = {value!r} must be a mapping")
    return value


def _number(path: Path, given: Mapping[str, Any], entry: str, name: str) -> float | None:
    """Read a number above 0; None where it is not given."""
    value = given.get(name)
    if value is None:
        return None
    try:
        number = float(value)  # YAML takes 1e-4, without a point, for a word
    except (TypeError, ValueError):
        number = float("nan")
    if not number > 0:
        raise RecordingError(
            f"{path}: {entry}: {name} = {value!r} must be a number above 0"
        )
    return number


def _file(
    folder: Path, path: Path, given: Mapping[str, Any], name: str, default: str | None
) -> Path | None:
    """Find a file that the entry names; the default only where it is there."""
    value = given.get(name)
    if value is None:
        there = default is not None and (folder / default).is_file()
        return folder / str(default) if there else None
    if not (folder / str(value)).is_file():
        raise RecordingError(f"{path}: {name}: {folder / str(value)} is not there")
    return folder / str(value)


def _texts(path: Path, given: Mapping[str, Any], name: str) -> tuple[str, ...]:
    value = given.get(name) or ()
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise RecordingError(f"{path}: {name} = {value!r} must be a list of texts")
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
        raise RecordingError(f"{path}: amplifiers must be a list")
    names = []
    for entry in given:
        if not isinstance(entry, Mapping) or "name" not in entry or set(entry) - allowed:
            raise RecordingError(
                f"{path}: amplifiers: {entry!r} must have a name, and of {sorted(allowed)} only"
            )
        names.append(str(entry["name"]))
    if len(set(names)) < len(names):
        raise RecordingError(f"{path}: amplifiers: names {names} must differ")
    return tuple(given)
