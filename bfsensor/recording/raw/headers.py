"""Headers of a FITS file, the layout of its amplifiers, and checks that it is complete."""

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
"""Sections that campaign.yaml may give for an amplifier, and the keyword that each stands for."""

SHARED_SECTIONS = ("DATASEC", "BIASSEC", "CCDSUM")
"""Keywords that a primary header without an image may give for all amplifiers.

DETSEC is not among them: each amplifier has its own place on the sensor.
"""

CONDITION_TABLES = ("TEST_COND", "CCD_COND")
"""Extensions of LSST's test stands whose headers hold voltages and temperatures."""

_SAMPLE = 1 << 15
"""Bytes of each of three samples of an image that are compared to find duplicates.

Chosen: twice as many reads twice as many bytes of every file.  The result does not depend on it:
files whose samples agree are compared as a whole.
"""


@dataclass(frozen=True)
class FileScan:
    """Headers of one raw file and the layout of its amplifiers.

    Attributes
    ----------
    path : Path
        The file.
    units : dict of str to str
        Units by keyword, from the comments of the primary header.
    amplifiers : tuple of AmplifierLayout
        One for each amplifier, in the order of the file.
    lamp : float or None
        Mean current of the photodiode [nA], where the file has a table of it against time.
    sample : str
        Digest of parts of the data, equal for equal data.
    own : tuple of mappings
        Values by keyword of the extensions, in the order of ``amplifiers``.
    problems : tuple of mappings
        For each amplifier why its 'gain', 'noise' or 'saturation' cannot be used; empty where
        all that are given can.
    spans : tuple of (int, int)
        Offset of each part of the data in the file, and its length [byte].
    """

    path: Path
    cards: Mapping[str, Any]
    """Values by keyword of the primary header, and of the extensions that hold only conditions."""
    units: Mapping[str, str]
    amplifiers: tuple[AmplifierLayout, ...]
    lamp: float | None = None
    sample: str = ""
    own: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)
    problems: tuple[Mapping[str, str], ...] = ()
    spans: tuple[tuple[int, int], ...] = field(default=(), repr=False)


def is_fits(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name ends as those of FITS files do, in small letters or capitals.

    Examples
    --------
    >>> is_fits("flat_1.FIT"), is_fits("flat.fits.fz"), is_fits("notes.txt")
    (True, True, False)
    """
    return str(path).lower().endswith(SUFFIXES)


def header_cards(header: fits.Header) -> dict[str, Any]:
    """Values of a header by keyword; comments and history are left out."""
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
    """Read the headers of a file, not its pixels, and check that it is not cut short.

    Parameters
    ----------
    path : path-like
        Raw FITS: one extension for each amplifier or one image, plain or tile-compressed.
    amplifiers : sequence of mappings, optional
        The ``amplifiers:`` of campaign.yaml, which replace what the headers say.
    overrides : mapping of str to Override, optional
        The ``keywords:`` of campaign.yaml.

    Returns
    -------
    scan : FileScan
        Headers and layout.

    Raises
    ------
    RecordingError
        The file is truncated or damaged, holds no two-dimensional image or several exposures, or
        a section leaves its image.  The message names file and extension.
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
    """Collect headers and layout of an open file."""
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
        raise RecordingError(
            f"is truncated: it has {size} of {sum(spans[-1])} bytes; copy it again"
        )
    if not images:
        cubes = [cube for hdu in hdus if (cube := _cube_shape(hdu.header)) is not None]
        if cubes:
            count, ny, nx = cubes[0]
            raise RecordingError(
                f"holds a cube of {count} images of {nx} x {ny} pixels: a file is one exposure; "
                "write each plane as a file of its own with its own header, in Python "
                "fits.writeto(f'flat_{k:03}.fits', cube[k], header)"
            )
        raise RecordingError("holds no two-dimensional image (NAXIS = 2) in any extension")
    # Test stands write the sections that all amplifiers share into a primary header without image.
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
    """Layouts of the amplifiers, their extensions' headers, their entries of campaign.yaml."""
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
            raise RecordingError(
                f"{name}: no image in HDU {wanted} (amplifiers: hdu); HDUs with images: {there}"
            )
        _, shape, own = images[wanted]
        # Some cameras have a keyword WINDOW of another meaning than campaign.yaml's entry.
        cards = {**shared, **own, "WINDOW": None}
        cards |= {
            card: entry[word] for word, card in SECTION_ENTRIES.items() if word in entry
        }
        yield layout_of(name, name, wanted, shape, cards), own, entry


def _mean_current(hdu: fits.BinTableHDU, cards: Mapping[str, Any]) -> float | None:
    """Mean photodiode current over the exposure [nA], from its table of time [s] and current [A].

    The dark current of the diode, the median of the lowest tenth of the readings, is subtracted.
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
    """Digest of all data of a file, equal for equal pixels."""
    return _digest(scan.path, scan.spans, whole=True)


def file_sha256(path: Path) -> str:
    """SHA-256 of a whole file in hexadecimal digits."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while piece := stream.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def _digest(path: Path, spans: Sequence[tuple[int, int]], *, whole: bool) -> str:
    """Digest of all data, or of the first, middle and last 32 KiB of each extension's."""
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
