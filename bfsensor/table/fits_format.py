"""FITS files of distortion tables: layout, checks, and storage of one quadrant where symmetric."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import NDArray

from bfsensor.errors import TableError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.recording.raw.open_fits import limited_axes
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor distortion table"
"""Value of the keyword SCHEMA, which names the kind of file."""

SCHEMA_VERSION = 1
"""Version of the file's layout, by definition; files of another version are refused."""

ARRAYS = ("corners", "horizontal", "vertical")
"""Arrays of displacements, each an image extension of that name in capitals."""

AXES = ("charges", "backgrounds", "depths")
"""Axes of the arrays, each an image extension of that name in capitals."""

UNITS = {
    **{name.upper(): "um" for name in ARRAYS}, "CHARGES": "electron", "BACKGROUNDS": "electron",
    "DEPTHS": "um", "DRIFT": "V/um",
}  # fmt: skip
"""BUNIT of the extensions; a file in which it is missing or empty is read, as it has these units."""


def write_table(table: Any, path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Write a distortion table, whole or not at all.

    Parameters
    ----------
    table : DistortionTable
        Any; only one quadrant is stored where it is mirror-symmetric bit for bit.
    path : path-like
        Where to.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    TableError
        The file exists and ``overwrite`` is not set, or it cannot be written.
    """
    refuse_existing(path, overwrite, TableError)
    arrays = {name: getattr(table, name) for name in ARRAYS}
    quadrants = {name: _quadrant(array) for name, array in arrays.items()}
    quadrant = table.symmetric and all(
        np.array_equal(_whole(name, quadrants[name]), array)
        for name, array in arrays.items()
    )
    if quadrant:
        arrays = quadrants
    primary = fits.PrimaryHDU()
    header = primary.header
    header["SCHEMA"] = (SCHEMA, "what this file is")
    header["SCHEMAV"] = (SCHEMA_VERSION, "version of the schema")
    header["BUNIT"] = ("um", "unit of all displacements")
    header["VERTICES"] = (table.vertices, "vertices a side between the corners")
    header["REACH"] = (table.reach, "largest pixel offset")
    header["QUADRANT"] = (quadrant, "only offsets >= 0 are stored, the rest mirrored")
    header["SYMMETRC"] = (table.symmetric, "mirror-symmetric about the source pixel")
    header["PITCHX"] = (table.pitch[0], "[um] pixel pitch along the gates")
    header["PITCHY"] = (table.pitch[1], "[um] pixel pitch along the channel stops")
    header["THICKNSS"] = (table.thickness, "[um] height of the back surface")
    if np.isfinite(table.full_well):
        header["FULLWELL"] = (
            table.full_well,
            "[electron] charge at which a pixel spills",
        )
    header["DATE"] = (
        datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"),
        "[UTC] when this file was written",
    )
    # HISTORY and COMMENT are for people who look at the header; META is read back, because
    # header entries are cut and escaped.
    for key, text in table.provenance.items():
        header["HISTORY"] = _printable(f"{key} = {text}")
    for key, error in table.errors.items():
        header["COMMENT"] = _printable(f"error: {key} = {error:.3g}")
    hdus = [primary]
    for name, array in arrays.items():
        hdu = fits.ImageHDU(array.astype(np.float32), name=name.upper())
        hdu.header["BUNIT"] = "um"
        hdus.append(hdu)
    for name in AXES:
        hdu = fits.ImageHDU(getattr(table, name), name=name.upper())
        hdu.header["BUNIT"] = UNITS[name.upper()]
        hdus.append(hdu)
    meta = json.dumps(
        {"errors": dict(table.errors), "provenance": dict(table.provenance)},
        sort_keys=True,
    )
    for name, text in (("META", meta), ("DEVICE", table.device_text)):
        data = np.frombuffer(text.encode(), np.uint8) if text else None
        hdus.append(fits.ImageHDU(data, name=name))
    if table.drift_field.size:
        hdus.append(drift_extension(table.drift_field))
    with written_whole(path, TableError) as beside:
        fits.HDUList(hdus).writeto(beside, checksum=True, overwrite=True)


def drift_extension(field: FloatArray) -> fits.ImageHDU:
    """Store the drift field of the empty device [V/um], which files may lack."""
    hdu = fits.ImageHDU(field, name="DRIFT")
    hdu.header["BUNIT"] = "V/um"
    return hdu


def read_fields(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the fields of a distortion table.

    Parameters
    ----------
    path : path-like
        FITS file that :func:`write_table` wrote.

    Returns
    -------
    fields : dict of str to object
        Arguments of :class:`~bfsensor.table.table.DistortionTable` by name.

    Raises
    ------
    TableError
        The file is missing, of another kind or schema, or damaged; the message names it.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise TableError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            # astropy only warns of a wrong checksum or a short file; here both are errors.
            warnings.simplefilter("error", AstropyWarning)
            # Opened here, because astropy does not close a file whose headers it cannot read.
            with (
                open(path, "rb") as stream,
                fits.open(limited_axes(stream), checksum=True) as hdus,
            ):
                header = hdus[0].header
                _check_schema(header, path)
                _check_extensions([(hdu.name, hdu.header) for hdu in hdus[1:]], path)
                data = {hdu.name: hdu.data for hdu in hdus[1:]}
                hdus[0].verify("exception")
    except TableError:
        raise
    # Damaged headers end in many kinds of exception inside astropy.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise TableError(f"{path}: not a FITS file, or damaged: {reason}") from None
    needed = [name.upper() for name in (*ARRAYS, *AXES, "meta", "device")]
    missing = [name for name in needed if name not in data]
    if missing:
        raise TableError(f"{path}: truncated: {', '.join(missing)} is missing")
    try:
        return _fields(header, data)
    except KeyError as error:
        raise TableError(f"{path}: not a FITS file, or damaged: {error.args[0]}") from None
    except (ValueError, TypeError, AttributeError, IndexError) as error:
        raise TableError(f"{path}: {error}") from None


def _check_extensions(hdus: list[tuple[str, Mapping[str, Any]]], path: Path) -> None:
    """Refuse two extensions of one name, and data in other units than this version reads."""
    seen: set[str] = set()
    for name, header in hdus:
        if name in seen:
            raise TableError(f"{path}: two extensions have the name {name!r}")
        seen.add(name)
        unit, given = UNITS.get(name, ""), header.get("BUNIT", "")
        if given not in (unit, ""):
            raise TableError(f"{path}: {name}: BUNIT = {given!r} must be {unit!r}")


def _number(header: Mapping[str, Any], key: str) -> float:
    """Return the number of a keyword; texts and logical values are none."""
    value = header[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} = {value!r} is not a number")
    return value


def _flag(header: Mapping[str, Any], key: str) -> bool:
    """Return the logical value of a keyword."""
    if not isinstance(header[key], bool):
        raise ValueError(f"{key} = {header[key]!r} must be T or F")
    return bool(header[key])


def _fields(header: Mapping[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    """Fields of a table from the primary header and the data of the extensions."""
    arrays = {}
    for name in ARRAYS:
        array = np.array(data[name.upper()], float)
        arrays[name] = _whole(name, array) if _flag(header, "QUADRANT") else array
        pitch = min(_number(header, "PITCHX"), _number(header, "PITCHY"))
        if array.size and not np.abs(array).max() < pitch:
            raise ValueError(
                f"{name.upper()}: a vertex is shifted by {np.abs(array).max():g} um, a pixel "
                f"({pitch:g} um) or more"
            )
    meta = json.loads(_text(data["META"]))
    return {
        **{name: np.array(data[name.upper()], float) for name in AXES},
        "pitch": (_number(header, "PITCHX"), _number(header, "PITCHY")),
        "thickness": _number(header, "THICKNSS"),
        "vertices": _number(header, "VERTICES"),
        "reach": _number(header, "REACH"),
        "full_well": _number(header, "FULLWELL") if "FULLWELL" in header else float("nan"),
        "errors": meta["errors"],
        "provenance": meta["provenance"],
        "device_text": _text(data["DEVICE"]),
        "symmetric": _flag(header, "SYMMETRC"),
        "drift_field": np.array(data.get("DRIFT", ()), float),
        **arrays,
    }


def _check_schema(header: Mapping[str, Any], path: Path) -> None:
    """Refuse a file that is no table of the schema that this version reads."""
    if header.get("SCHEMA") != SCHEMA:
        raise TableError(f"{path}: not a distortion table (no SCHEMA = '{SCHEMA}')")
    if header.get("BUNIT", "um") != "um":
        raise TableError(f"{path}: BUNIT = {header['BUNIT']!r} must be 'um'")
    if header.get("SCHEMAV") is True or header.get("SCHEMAV") != SCHEMA_VERSION:
        raise TableError(
            f"{path}: schema version {header.get('SCHEMAV')} is not {SCHEMA_VERSION}, the "
            "one this version of bfsensor reads"
        )


def _printable(text: str) -> str:
    """Escape text to printable ASCII, the only characters that a FITS header may hold."""
    return text.encode("unicode_escape").decode("ascii")


def _text(data: NDArray[np.uint8] | None) -> str:
    """Decode the text of an extension; empty where it has no data."""
    return "" if data is None else data.astype(np.uint8).tobytes().decode()


def _quadrant(array: FloatArray) -> FloatArray:
    """Cut out the pixel offsets from 0 on, in x and in y."""
    ny, nx = array.shape[3:5]
    return array[:, :, :, ny // 2 :, nx // 2 :]


def _whole(name: str, quadrant: FloatArray) -> FloatArray:
    """Mirror a quadrant to the whole array; the source's own row and column are not doubled."""
    x, y, vertex = 4, 3, 5
    for axis, sides, sign in ((x, "horizontal", (-1.0, 1.0)), (y, "vertical", (1.0, -1.0))):
        mirrored = np.flip(quadrant, axis) * np.array(sign)
        # These sides have one entry a pixel along the axis, so that the middle one would be
        # doubled, and their vertices run along it; the others have one entry an edge line.
        if name == sides:
            mirrored = np.flip(mirrored, vertex)
            mirrored = np.delete(mirrored, -1, axis)
        quadrant = np.concatenate([mirrored, quadrant], axis) + 0.0
    return quadrant
