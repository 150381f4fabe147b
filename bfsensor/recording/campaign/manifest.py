"""List of a campaign's exposures, from manifest.ecsv, from headers, or from both."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.exposures import LIT, TOLERANCES
from bfsensor.recording.campaign.settings import CampaignSettings
from bfsensor.recording.raw.headers import FileScan, file_sha256, is_fits, scan_file
from bfsensor.recording.raw.keywords import MEANINGS, Override, kind_in_name, translate
from bfsensor.text_files import UnreadableTextError, nearly_equal, read_ecsv

COLUMNS = {
    "file": ("file", "filename", "path"), "kind": ("imgtype", "kind", "type"),
    "number": ("seq", "seqnum", "number"), "mjd": ("mjd",),
    "exposure_time": ("exptime", "exposure_time"), "wavelength": ("wavelength", "monowl"),
    "filter": ("filter",), "temperature": ("temp", "temperature", "ccdtemp"),
    "back_bias": ("vbb", "back_bias"), "gate_high": ("parlhi", "gate_high"),
    "gate_low": ("parllo", "gate_low"), "lamp": ("diode", "lamp", "mondiode"),
    "pair": ("pair",), "sha256": ("sha256",),
}  # fmt: skip
"""Names of manifest.ecsv's columns by quantity, of which the first found is read.

A column without a unit has the unit of headers (``header_unit`` of
:data:`bfsensor.recording.raw.keywords.MEANINGS`).
"""


@dataclass
class Entry:
    """One file or row of the manifest while a campaign is read.

    Attributes
    ----------
    path : Path
        The file; it need not exist where only the manifest names it.
    row : mapping or None
        Quantities of the manifest's row; None without one.
    said : dict
        Quantities of the manifest, and of the header where the manifest has none.
    scan : FileScan or None
        Headers; None where the file could not be read.
    reason : str
        Why the file is set aside; '' where it is not.
    disagree : tuple of str
        Quantities in which manifest and header differ, with both values.
    problems : tuple of str
        Values outside their possible range.
    kind_from_name : bool
        True where the kind is known by the file's name only.
    """

    path: Path
    row: Mapping[str, Any] | None = None
    said: dict[str, Any] = field(default_factory=dict)
    scan: FileScan | None = None
    reason: str = ""
    disagree: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    kind_from_name: bool = False


def list_files(folder: Path) -> list[Path]:
    """FITS files of a folder, sorted by name with numbers in numerical order.

    Raises
    ------
    RecordingError
        The folder does not exist.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")
    return sorted(
        (one for one in folder.iterdir() if one.is_file() and is_fits(one.name)),
        key=lambda one: natural(one.name),
    )


def natural(name: str) -> list[tuple[int, float, str]]:
    """Sort key of a file name that puts 'flat9.5' before 'flat10'."""
    parts = re.split(r"(\d+(?:\.\d+)?)", name.lower())
    return [(0, float(p), "") if p[:1].isdigit() else (1, 0.0, p) for p in parts]


def read_manifest(
    path: Path, overrides: Mapping[str, Override] | None = None
) -> list[dict[str, Any]]:
    """Read manifest.ecsv.

    Parameters
    ----------
    path : Path
        The file.
    overrides : mapping of str to Override, optional
        The ``keywords:`` of campaign.yaml: units and scales of columns that have no unit, and
        words of kinds.

    Returns
    -------
    rows : list of dict
        Quantities of each row in the units of :func:`bfsensor.recording.raw.keywords.translate`;
        None where a cell is empty.

    Raises
    ------
    RecordingError
        The file is not ECSV, or has no column of file names.
    """
    try:
        table = read_ecsv(path)
    except UnreadableTextError as error:
        raise RecordingError(f"{path}: not readable as ECSV: {error}") from None
    lower = {name.lower(): name for name in table.colnames}
    there = {
        name: next(lower[word] for word in words if word in lower)
        for name, words in COLUMNS.items()
        if any(word in lower for word in words)
    }
    known = [word for words in COLUMNS.values() for word in words]
    for name in lower:
        meant = [words[0] for key, words in COLUMNS.items() if key not in there]
        near = next((word for word in meant if nearly_equal(name, word)), None)
        if name not in known and near is not None:
            raise RecordingError(
                f"{path}: column {name!r} is not known; did you mean {near!r}?"
            )
    if "file" not in there:
        raise RecordingError(
            f"{path}: no column 'file' with the names of the exposures' files among "
            f"{', '.join(table.colnames)}"
        )
    units = {
        MEANINGS[name].keywords[0]: str(table[column].unit)
        for name, column in there.items()
        if name in MEANINGS and table[column].unit is not None
    }
    scales = {
        name: Override(unit=one.unit, scale=one.scale, values=one.values)
        for name, one in (overrides or {}).items()
        if MEANINGS[name].keywords[0] not in units
    }
    rows = []
    for k in range(len(table)):
        plain = {name: _plain(table[column][k]) for name, column in there.items()}
        cards = {
            MEANINGS[name].keywords[0]: value
            for name, value in plain.items()
            if name in MEANINGS and value is not None
        }
        said, problems = translate(cards, card_units=units, overrides=scales)
        if plain.get("mjd") is not None and not _is_time(plain["mjd"]):
            problems = (*problems, f"mjd = {plain.pop('mjd')!r} is no finite number")
        said.update({name: plain.get(name) for name in ("file", "mjd", "pair", "sha256")})
        said["problems"] = problems
        rows.append(said)
    return rows


def gather(
    folder: Path, settings: CampaignSettings, progress: Any = None
) -> tuple[list[Entry], bool]:
    """Read all headers and compare them with the manifest.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.
    settings : CampaignSettings
        Settings of its campaign.yaml.
    progress : callable, optional
        Function that is called with the number of files done and the number of all.

    Returns
    -------
    entries : list of Entry
        Rows of the manifest in its order, then files without a row.  Entries have a reason
        where a file is missing, broken, changed since the manifest, excluded or of no known
        kind.
    has_manifest : bool
        True where a manifest has rows.
    """
    files = {one.name: one for one in list_files(folder)}
    rows = read_manifest(settings.manifest, settings.overrides) if settings.manifest else []
    entries: list[Entry] = []
    taken: set[Path] = set()
    for row in rows:
        path = folder / str(row["file"])
        one = Entry(path, row)
        if path in taken:
            one.reason = "in the manifest twice"
        elif not path.is_file():
            one.reason = "in the manifest, but there is no such file"
        taken.add(path)
        entries.append(one)
    entries += [Entry(path) for path in files.values() if path not in taken]
    for k, one in enumerate(entries):
        one.reason = one.reason or settings.reason_to_exclude(one.path.name) or ""
        if not one.reason:
            _read_entry(one, settings)
        elif one.row is not None:
            one.said = dict(one.row)
        if progress is not None:
            progress(k + 1, len(entries))
    return entries, bool(rows)


def _read_entry(one: Entry, settings: CampaignSettings) -> None:
    """Fill an entry from its file, or set it aside with the reason."""
    row = one.row or {}
    one.said = dict(row)
    try:
        scan = scan_file(
            one.path, amplifiers=settings.amplifiers or None, overrides=settings.overrides
        )
    except RecordingError as error:
        one.reason = str(error).removeprefix(f"{one.path}: ")
        return
    one.scan = scan
    sha = row.get("sha256")
    if sha and file_sha256(one.path) != str(sha).lower():
        one.reason = (
            "its SHA-256 is not the manifest's: the file was changed or replaced; copy it again, "
            "or correct the manifest"
        )
        return
    cards = dict(scan.cards)
    for own in scan.own:
        cards = {**own, **cards}
    header, problems = translate(cards, card_units=scan.units, overrides=settings.overrides)
    if header["lamp"] is None and header["kind"] not in ("bias", "dark"):
        header["lamp"] = scan.lamp
    said, disagree = {}, []
    for name, value in header.items():
        given = row.get(name)
        fixed = settings.overrides.get(name)
        if given is None or (fixed is not None and fixed.value is not None):
            said[name] = value
            continue
        said[name] = given
        if value is not None and _differ(name, given, value):
            disagree.append(
                f"{name} {_short(given)} in the manifest, {_short(value)} in the header"
            )
    one.said = {**said, "pair": row.get("pair"), "sha256": sha}
    one.disagree = tuple(disagree)
    own = dict.fromkeys(text for wrong in scan.problems for text in wrong.values())
    one.problems = (*problems, *own, *row.get("problems", ()))
    if one.said["kind"] is None:
        one.said["kind"] = kind_in_name(one.path.name)
        one.kind_from_name = one.said["kind"] is not None
    if one.said["kind"] is None:
        one.reason = next(
            (text for text in one.problems if "as a kind of exposure" in text),
            "neither header, manifest nor file name states the kind of exposure; add a column kind "
            "to manifest.ecsv, or the header's keyword to campaign.yaml: keywords: {kind: KEYWORD}",
        )
    elif one.said["kind"] in ("bias", "dark"):
        one.said.update(dict.fromkeys(("wavelength", "filter", "lamp")))


def set_order(entries: Sequence[Entry]) -> list[Entry]:
    """Put entries in the order of time.

    The order is that of time stamps where most have one, else of numbers, else that of the
    manifest or of names.  An entry without a stamp stays behind its neighbour in the manifest or by
    name.
    """
    used = [one for one in entries if not one.reason]
    for clock in ("mjd", "number"):
        having = [one for one in used if one.said.get(clock) is not None]
        if len(having) * 2 <= len(used) or not having:
            continue
        if any(one.row is None for one in entries):
            entries = sorted(entries, key=lambda one: natural(one.path.name))
        last, keys = -np.inf, []
        for one in entries:
            value = one.said.get(clock)
            last = last if value is None else float(value)
            keys.append(last)
        return [entries[k] for k in np.argsort(keys, kind="stable")]
    return list(entries)


def _differ(name: str, one: Any, other: Any) -> bool:
    """Whether values of manifest and header differ by more than rounding and jitter."""
    if name == "kind":
        return bool(one != other) and not {one, other} <= set(LIT)
    if name == "exposure_time":
        return bool(abs(one - other) > 0.01 * max(one, other) + 0.01)
    if name in TOLERANCES:
        return bool(abs(one - other) > TOLERANCES[name])
    return False


def _plain(value: Any) -> Any:
    """Value of a table's cell as a Python object; None where it is masked, blank or nan."""
    if value is np.ma.masked:
        return None
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and np.isnan(value):
        return None
    return None if value == "" else value


def _is_time(value: Any) -> bool:
    """Whether a time stamp is a finite number."""
    return isinstance(value, int | float) and bool(np.isfinite(value))


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
