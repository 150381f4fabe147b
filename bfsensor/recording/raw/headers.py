"""One look at a FITS file without its pixels: cards, amplifiers, and whether it is whole."""

from __future__ import annotations

import gzip
import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from scipy.integrate import trapezoid

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.keywords import (
    AMPLIFIER_UNITS,
    MEANINGS,
    Override,
    amplifier_quantity,
    header_units,
)
from bfsensor.recording.raw.open_fits import open_fits
from bfsensor.recording.raw.sections import AmplifierLayout, layout_of

SUFFIXES = (".fits", ".fit", ".fts", ".fits.fz", ".fits.gz", ".fit.gz")
SECTION_ENTRIES = {
    "window": "WINDOW", "data": "DATASEC", "bias": "BIASSEC", "detector": "DETSEC",
}  # fmt: skip
"""Sections that campaign.yaml may give for an amplifier, and the card that each stands for."""

SHARED_SECTIONS = ("DATASEC", "BIASSEC", "CCDSUM")
"""Cards that all amplifiers may have in common; a place on the sensor is each one's own."""

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
    problems : tuple of mappings
        What is wrong with the gain, noise or saturation of each amplifier, by those words.
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
    problems: tuple[Mapping[str, str], ...] = ()
    spans: tuple[tuple[int, int], ...] = field(default=(), repr=False)


def is_fits(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name is one of FITS, of either case.

    Examples
    --------
    >>> is_fits("flat_1.FIT"), is_fits("flat.fits.fz"), is_fits("notes.txt")
    (True, True, False)
    """
    return str(path).lower().endswith(SUFFIXES)


def header_cards(header: fits.Header) -> dict[str, Any]:
    """Cards with a value, by keyword; comments and history are left out."""
    skipped = ("COMMENT", "HISTORY", "", "SIMPLE", "XTENSION", "BITPIX", "BSCALE", "BZERO")
    return {
        card.keyword: card.value
        for card in header.cards
        if card.keyword not in skipped and not isinstance(card.value, fits.card.Undefined)
    }


def scan_file(
    path: str | os.PathLike[str],
    *,
    amplifiers: Sequence[Mapping[str, Any]] | None = None,
    overrides: Mapping[str, Override] | None = None,
) -> FileScan:
    """Read the headers of a file, not its pixels, and check that nothing was cut off.

    Parameters
    ----------
    path : path-like
        Raw FITS: one extension for each amplifier or one image, plain or tile-compressed.
    amplifiers : sequence of mappings, optional
        What campaign.yaml says of each amplifier, before the headers.
    overrides : mapping of str to Override, optional
        Keywords that campaign.yaml puts before the table's.

    Returns
    -------
    FileScan

    Raises
    ------
    RecordingError
        The file is truncated, damaged, holds no image or sections that leave it; names
        file and extension.
    """
    path = Path(path)
    with open_fits(path, as_stored=True) as hdus:
        try:
            return _scan(path, hdus, amplifiers, overrides or {})
        except RecordingError as error:
            raise RecordingError(f"{path}: {error}") from None


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
        cubes = [cube for hdu in hdus if (cube := _cube_shape(hdu.header)) is not None]
        if cubes:
            count, ny, nx = cubes[0]
            raise RecordingError(
                f"holds a cube of {count} images of {nx} x {ny} pixels: a file is one exposure; "
                "write each plane as a file of its own with its own header, in Python "
                "fits.writeto(f'flat_{k:03}.fits', cube[k], header)"
            )
        raise RecordingError("holds no two-dimensional image")
    # A primary header without an image speaks for all extensions.
    shared = {} if 0 in images else {card: cards.get(card) for card in SHARED_SECTIONS}
    layouts, problems = [], []
    for layout, own, stated in _layouts(images, given, shared):
        found = {
            word: amplifier_quantity(
                word, own, cards, stated=stated.get(word), overrides=overrides
            )
            for word in AMPLIFIER_UNITS
        }
        layouts.append(
            replace(
                layout, gain=found["gain"][0], noise=found["noise"][0],
                saturation=found["saturation"][0],
            )
        )  # fmt: skip
        problems.append({word: wrong for word, (_, wrong) in found.items() if wrong})
    _refuse_several([images[layout.hdu][2] for layout in layouts])
    return FileScan(
        path, cards, units, tuple(layouts), lamp, _digest(path, tuple(spans), whole=False),
        tuple(images[layout.hdu][2] for layout in layouts), tuple(problems), tuple(spans),
    )  # fmt: skip


def _cube_shape(header: fits.Header) -> tuple[int, int, int] | None:
    """Planes, rows and columns of a cube; None for anything else."""
    z = "Z" if header.get("ZIMAGE") else ""
    if header.get(f"{z}NAXIS", 0) != 3:
        return None
    planes, ny, nx = (int(header[f"{z}NAXIS{axis}"]) for axis in (3, 2, 1))
    return planes, ny, nx


def _refuse_several(images: Sequence[Mapping[str, Any]]) -> None:
    """Refuse a file whose images are exposures: amplifiers share one kind and time."""
    for keyword in (*MEANINGS["kind"].keywords, "EXPTIME", "EXPOSURE"):
        values = {cards[keyword] for cards in images if keyword in cards}
        if len(values) > 1:
            words = ", ".join(sorted(map(str, values))[:3])
            raise RecordingError(
                f"holds several exposures: {keyword} differs among its {len(images)} images "
                f"({words}); a file is one exposure, its extensions are amplifiers; write each "
                "as a file of its own, in Python fits.writeto(name, hdu.data, hdu.header)"
            )


def _image_shape(header: fits.Header) -> tuple[int, int] | None:
    """Shape of a two-dimensional image, compressed ones as they will come out."""
    z = "Z" if header.get("ZIMAGE") else ""
    table = str(header.get("XTENSION", "IMAGE")).strip() != "IMAGE"
    if (table and not z) or header.get(f"{z}NAXIS", 0) != 2:
        return None
    return int(header[f"{z}NAXIS2"]), int(header[f"{z}NAXIS1"])


def _layouts(
    images: Mapping[int, tuple[str, tuple[int, int], dict[str, Any]]],
    given: Sequence[Mapping[str, Any]] | None,
    shared: Mapping[str, Any],
) -> Iterator[tuple[AmplifierLayout, dict[str, Any], Mapping[str, Any]]]:
    """Amplifiers with the cards of their extensions and what campaign.yaml says of them."""
    names = [name for name, _, _ in images.values()]
    if not given:
        given = [
            {"name": f"{name or 'image'} {hdu}" if names.count(name) > 1 else name or "image",
             "hdu": hdu}
            for hdu, (name, _, _) in images.items()
        ]  # fmt: skip
    for entry in given:
        name, wanted = str(entry["name"]), entry.get("hdu")
        if wanted is None:
            named = [k for k, (label, _, _) in images.items() if label == name]
            wanted = (named or list(images))[0]
        if wanted not in images:
            there = ", ".join(str(k) for k in images)
            raise RecordingError(f"{name}: no image in HDU {wanted}; there are {there}")
        _, shape, own = images[wanted]
        # A card WINDOW of a camera is another thing than campaign.yaml's.
        cards = {**shared, **own, "WINDOW": None}
        cards |= {
            card: entry[word] for word, card in SECTION_ENTRIES.items() if word in entry
        }
        yield layout_of(name, name, wanted, shape, cards), own, entry


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
