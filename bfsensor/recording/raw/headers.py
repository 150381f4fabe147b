"""One look at a FITS file without its pixels: cards, amplifiers, and whether it is whole."""

from __future__ import annotations

import gzip
import hashlib
import os
import warnings
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from scipy.integrate import trapezoid

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.fits_images import header_cards
from bfsensor.recording.raw.keywords import Override, header_units, quantity
from bfsensor.recording.raw.sections import AmplifierLayout, layout_of

SUFFIXES = (".fits", ".fit", ".fts", ".fits.fz", ".fits.gz", ".fit.gz")
BROKEN = (
    OSError, EOFError, ValueError, TypeError, LookupError, zlib.error, fits.VerifyError,
)  # fmt: skip
"""What astropy may raise on a damaged file."""

AMPLIFIER_ENTRIES = {
    "window": "WINDOW", "data": "DATASEC", "bias": "BIASSEC", "detector": "DETSEC",
    "gain": "CCDGAIN", "noise": "CCDNOISE", "saturation": "SATURATE",
}  # fmt: skip
"""What campaign.yaml may say of an amplifier, beside name and hdu, and the card it stands for."""

CONDITION_TABLES = ("TEST_COND", "CCD_COND")
_SAMPLE = 1 << 15


@dataclass(frozen=True)
class FileScan:
    """What the headers of one file say.

    Attributes
    ----------
    path : Path
        The file.
    cards : dict of str to value
        Of the primary header, and of the extensions that hold only conditions.
    units : dict of str to str
        Units that the cards' comments give.
    amplifiers : tuple of AmplifierLayout
        In the order of the file.
    lamp : float or None
        Mean current of a photodiode's table in the file [nA].
    sample : str
        Digest of parts of the data, equal for equal data.
    own : tuple of mappings
        Cards of the extensions, in the order of ``amplifiers``.
    spans : tuple of (int, int)
        Where data begin in the file, and their length [byte].
    """

    path: Path
    cards: Mapping[str, Any]
    units: Mapping[str, str]
    amplifiers: tuple[AmplifierLayout, ...]
    lamp: float | None = None
    sample: str = ""
    own: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)
    spans: tuple[tuple[int, int], ...] = field(default=(), repr=False)


def is_fits(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name is one of FITS, of either case.

    Examples
    --------
    >>> is_fits("flat_1.FIT"), is_fits("flat.fits.fz"), is_fits("notes.txt")
    (True, True, False)
    """
    return str(path).lower().endswith(SUFFIXES)


def scan_file(
    path: Path,
    *,
    amplifiers: Sequence[Mapping[str, Any]] | None = None,
    overrides: Mapping[str, Override] | None = None,
) -> FileScan:
    """Read the headers of a file, not its pixels, and check that nothing was cut off.

    Parameters
    ----------
    path : Path
        Raw FITS: one extension for each amplifier or one image, plain or tile-compressed.
    amplifiers : sequence of mappings, optional
        What campaign.yaml says of each amplifier, before the headers.
    overrides : mapping of str to Override, optional
        Keywords that campaign.yaml puts before the table's.

    Raises
    ------
    RecordingError
        The file is truncated, damaged, holds no image or sections that leave it; names
        the extension, not the file.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", AstropyUserWarning)
        try:
            # A tile-compressed image is the table it is stored as: five times faster.
            with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
                found = _scan(path, hdus, amplifiers, overrides or {})
        except RecordingError:
            raise
        except BROKEN as error:
            raise RecordingError(f"cannot be read: {_one_line(error)}") from None
    for warning in caught:
        text = _one_line(warning.message)
        if any(word in text for word in ("truncated", "corrupted", "validating header")):
            raise RecordingError(f"is truncated or damaged: {text}")
    return found


def _scan(
    path: Path, hdus: fits.HDUList, given: Sequence[Mapping[str, Any]] | None,
    overrides: Mapping[str, Override],
) -> FileScan:  # fmt: skip
    """Gather what an open file says."""
    cards = header_cards(hdus[0].header)
    units = header_units(hdus[0].header)
    images: dict[int, tuple[str, tuple[int, int], dict[str, Any]]] = {}
    spans, lamp = [], None
    for number, hdu in enumerate(hdus):
        place = hdu.fileinfo()
        if place["datSpan"]:
            spans.append((place["datLoc"], place["datSpan"]))
        shape = _image_shape(hdu.header)
        name = str(hdu.header.get("EXTNAME", "")).strip()
        if shape is not None:
            images[number] = (name, shape, header_cards(hdu.header))
        elif number and name.upper() in CONDITION_TABLES:
            cards = {**header_cards(hdu.header), **cards}
        elif "MEAS_TIMES" in name.upper() and isinstance(hdu, fits.BinTableHDU):
            lamp = _mean_current(hdu, cards)
    # The last block may lack its padding, never its data.
    size, compressed = path.stat().st_size, path.suffix.lower() == ".gz"
    if spans and not compressed and size < sum(spans[-1]):
        raise RecordingError(f"is truncated: {size} bytes of {sum(spans[-1])}")
    if not images:
        raise RecordingError("holds no two-dimensional image")
    found = _given_layouts(images, given) if given else _layouts(images)
    layouts = tuple(
        replace(layout, **{
            name: quantity(name, {**cards, **own}, overrides)
            for name in ("gain", "noise", "saturation")
        })
        for layout, own in found
    )  # fmt: skip
    return FileScan(
        path, cards, units, layouts, lamp, _digest(path, tuple(spans), whole=False),
        tuple(own for _, own in found), tuple(spans),
    )  # fmt: skip


def _image_shape(header: fits.Header) -> tuple[int, int] | None:
    """Shape of a two-dimensional image, compressed ones as they will come out."""
    z = "Z" if header.get("ZIMAGE") else ""
    table = str(header.get("XTENSION", "")).strip() == "BINTABLE"
    if (table and not z) or header.get(f"{z}NAXIS", 0) != 2:
        return None
    return int(header[f"{z}NAXIS2"]), int(header[f"{z}NAXIS1"])


def _layouts(
    images: Mapping[int, tuple[str, tuple[int, int], dict[str, Any]]],
) -> list[tuple[AmplifierLayout, dict[str, Any]]]:
    """Amplifiers as the headers have them, with their cards."""
    names = [name for name, _, _ in images.values()]
    out = []
    for number, (name, shape, own) in images.items():
        label = name or "image"
        if names.count(name) > 1:
            label = f"{label} {number}"
        out.append((layout_of(label, label, number, shape, own), own))
    return out


def _given_layouts(
    images: Mapping[int, tuple[str, tuple[int, int], dict[str, Any]]],
    given: Sequence[Mapping[str, Any]],
) -> list[tuple[AmplifierLayout, dict[str, Any]]]:
    """Amplifiers as campaign.yaml has them, with their cards."""
    out = []
    for entry in given:
        name, wanted = str(entry["name"]), entry.get("hdu")
        if wanted is None:
            named = [k for k, (label, _, _) in images.items() if label == name]
            wanted = (named or list(images))[0]
        if wanted not in images:
            there = ", ".join(str(k) for k in images)
            raise RecordingError(f"{name}: no image in HDU {wanted}; there are {there}")
        _, shape, own = images[wanted]
        cards = {**own}
        for word, card in AMPLIFIER_ENTRIES.items():
            if word in entry:
                cards[card] = entry[word]
        out.append((layout_of(name, name, wanted, shape, cards), cards))
    return out


def _mean_current(hdu: fits.BinTableHDU, cards: Mapping[str, Any]) -> float | None:
    """Mean photodiode current over the exposure [nA], from its table of time [s] and current [A].

    The current between exposures is the tables' lowest tenth, and taken off.
    """
    names = {str(name).upper(): name for name in hdu.columns.names}
    times = next((names[n] for n in names if n.endswith("MEAS_TIMES")), None)
    currents = next((names[n] for n in names if n.endswith("CURRENT")), None)
    seconds = cards.get("EXPTIME")
    if times is None or currents is None or not isinstance(seconds, int | float):
        return None
    t, current = (np.asarray(hdu.data[name], float) for name in (times, currents))
    if len(t) < 3 or seconds <= 0 or not np.all(np.isfinite(t) & np.isfinite(current)):
        return None
    current = np.abs(current)
    dark = np.median(np.sort(current)[: max(len(current) // 10, 1)])
    return float(trapezoid(current - dark, t) / seconds * 1e9)


def whole_digest(scan: FileScan) -> str:
    """Digest of all data of a file: equal pixels, equal digests."""
    return _digest(scan.path, scan.spans, whole=True)


def file_sha256(path: Path) -> str:
    """SHA-256 of a whole file, read in pieces."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while piece := stream.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def _digest(path: Path, spans: Sequence[tuple[int, int]], *, whole: bool) -> str:
    """Digest of the data: all of it, or the first, middle and last 32 kB of each part."""
    digest = hashlib.blake2b(digest_size=16)
    opener = gzip.open if path.suffix.lower() == ".gz" else open
    with opener(path, "rb") as stream:
        for start, length in spans:
            digest.update(str(length).encode())
            if whole:
                stream.seek(start)
                for at in range(0, length, 1 << 20):
                    digest.update(stream.read(min(1 << 20, length - at)))
                continue
            for at in (0, max(length // 2 - _SAMPLE // 2, 0), max(length - _SAMPLE, 0)):
                stream.seek(start + at)
                digest.update(stream.read(min(_SAMPLE, length - at)))
    return digest.hexdigest()


def _one_line(error: object) -> str:
    return " ".join(str(error).split())[:200]
