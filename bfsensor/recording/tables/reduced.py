"""Recordings that others reduced: covariances, spot sizes, radial profiles."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from astropy.io import ascii as text_tables
from astropy.io.ascii import InconsistentTableError
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.manifest import list_files
from bfsensor.recording.raw.headers import is_fits
from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
from bfsensor.recording.tables.covariance_tables import CovarianceTable, read_covariances
from bfsensor.typing import FloatArray

SPOT_COLUMNS = {
    "flux": ("flux", "total_e", "flux_e"), "peak": ("peak", "peak_e"),
    "sigma_x": ("sigma_x", "sigma_x_pix"), "sigma_y": ("sigma_y", "sigma_y_pix"),
    "size": ("T", "size"), "e1": ("e1",), "e2": ("e2",), "x": ("x",), "y": ("y",),
    "kurtosis": ("kurtosis",), "wavelength": ("wavelength",), "back_bias": ("vbb", "back_bias"),
}  # fmt: skip
"""Columns of spot tables by quantity: electrons and pixels, size T = Ixx + Iyy [pixel^2]."""

LABELS = ("amp", "amplifier", "segment", "state", "region")
"""Columns whose words part a spot table."""


@dataclass(frozen=True, eq=False)
class SpotTable:
    """Sizes, shapes and places of spots against their flux.

    Attributes
    ----------
    path : Path
        Where they came from.
    values : mapping of str to ndarray, shape (n,)
        By quantity, keys of :data:`SPOT_COLUMNS`.
    errors : mapping of str to ndarray, shape (n,)
        Of those that have any.
    group : ndarray of str, shape (n,)
        Words of the label columns, joined.
    warnings : tuple of str
    """

    path: Path
    values: Mapping[str, FloatArray]
    errors: Mapping[str, FloatArray]
    group: NDArray[np.str_]
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("values", "errors"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def what(self) -> str:
        """One line for a list."""
        groups = len(set(self.group.tolist()))
        return f"spots, {len(self.group)} rows, {groups} groups, {', '.join(self.values)}"


@dataclass(frozen=True, eq=False)
class RadialProfile:
    """A quantity against the distance from the wafer's centre: tree rings.

    Attributes
    ----------
    path : Path
        Where it came from.
    radius : ndarray, shape (n,)
        [pixel], ascending.
    value, error : ndarray, shape (n,)
        [unit]; error nan where not given, rows without a value are left out.
    unit : str
        As the caller says: files of this kind do not.
    warnings : tuple of str
    """

    path: Path
    radius: FloatArray
    value: FloatArray
    error: FloatArray
    unit: str = ""
    warnings: tuple[str, ...] = field(default=())

    @property
    def what(self) -> str:
        """One line for a list."""
        return (
            f"radial profile, {len(self.radius)} rows from {self.radius[0]:.0f} to "
            f"{self.radius[-1]:.0f} pixels, rms {np.std(self.value):.3g} {self.unit}".rstrip()
        )


Reduced = CovarianceTable | AreaChangeTable | SpotTable | RadialProfile


def read_spots(path: str | os.PathLike[str]) -> SpotTable:
    """Read a table of spots, ECSV or comma-separated.

    Parameters
    ----------
    path : path-like
        With a flux or peak [e-] and sigma_x and sigma_y [pixel] or T [pixel^2]; a column
        NAME_error (or NAME_err, NAME_sigma) is an error.

    Returns
    -------
    SpotTable

    Raises
    ------
    RecordingError
        No flux, or no size.
    """
    path = Path(path)
    table = _read_text(path)
    values, errors = {}, {}
    for name, words in SPOT_COLUMNS.items():
        column = next((word for word in words if word in table.colnames), None)
        if column is None:
            continue
        values[name] = np.asarray(table[column], float)
        for end in ("error", "err", "sigma"):
            if f"{column}_{end}" in table.colnames:
                errors[name] = np.asarray(table[f"{column}_{end}"], float)
    if not {"flux", "peak"} & set(values):
        raise RecordingError(f"{path}: no flux or peak among {', '.join(table.colnames)}")
    if not ({"sigma_x", "sigma_y"} <= set(values) or "size" in values):
        raise RecordingError(f"{path}: no sigma_x and sigma_y, nor T, among its columns")
    labels = [name for name in LABELS if name in table.colnames]
    group = np.array(
        [" ".join(str(table[name][k]) for name in labels) for k in range(len(table))], str
    )
    warnings = []
    sizes = [name for name in ("sigma_x", "sigma_y", "size") if name in values]
    if any(name not in errors for name in sizes):
        warnings.append("sizes without errors: take the scatter about a fit, and say so")
    if "x" not in values or "y" not in values:
        warnings.append("no positions: odd parts of the shifts cannot be tested")
    return SpotTable(path, values, errors, group, tuple(warnings))


def read_profile(path: str | os.PathLike[str], *, unit: str = "") -> RadialProfile:
    """Read a radial profile: columns of radius, value and, where there is one, error.

    Parameters
    ----------
    path : path-like
        Numbers in columns, or ECSV with the columns radius, value, error.
    unit : str
        Of the value, such as 'percent'.

    Returns
    -------
    RadialProfile

    Raises
    ------
    RecordingError
        Not two or three columns of numbers, fewer than ten values, or radii that do not
        ascend.
    """
    path = Path(path)
    if path.suffix == ".ecsv":
        table = _read_text(path)
        columns = [np.asarray(table[c], float) for c in ("radius", "value", "error")
                   if c in table.colnames]  # fmt: skip
        unit = unit or str(table["value"].unit or "") if "value" in table.colnames else unit
    else:
        try:
            columns = list(np.loadtxt(path, ndmin=2, unpack=True))
        except (OSError, ValueError) as error:
            raise RecordingError(f"{path}: cannot be read: {error}") from None
    if len(columns) not in (2, 3):
        raise RecordingError(f"{path}: {len(columns)} columns, not radius, value and error")
    radius, value = columns[:2]
    errors = columns[2] if len(columns) == 3 else np.full(len(radius), np.nan)
    kept = np.isfinite(radius) & np.isfinite(value)
    if kept.sum() < 10 or np.any(np.diff(radius[kept]) <= 0):
        raise RecordingError(f"{path}: fewer than ten values, or radii that do not ascend")
    warnings = []
    if len(columns) == 2:
        warnings.append("no errors: take the scatter between rings")
    if not unit:
        warnings.append("no unit: amplitudes can be compared among such files only")
    if not kept.all():
        warnings.append(f"{int((~kept).sum())} radii without a value left out")
    return RadialProfile(
        path, radius[kept], value[kept], errors[kept], unit, tuple(warnings)
    )


def find_reduced(path: str | os.PathLike[str]) -> tuple[Reduced, ...]:
    """Read what a folder, or one file, holds of reduced recordings.

    Known by their columns: covariances, a_ij, spots and profiles in ECSV (a_ij and spots
    also comma-separated), LSST's photon transfer datasets in FITS.  Other files are passed
    over in a folder.

    Raises
    ------
    RecordingError
        One file, of none of these kinds; or one of these that is wrong in itself.
    """
    path = Path(path)
    if path.is_file():
        found = _read_known(path)
        if found is None and is_fits(path.name):
            raise RecordingError(
                f"{path}: one FITS file is no campaign: give its folder, which needs flats of "
                "equal exposure time in pairs at several levels, and bias frames or an overscan, "
                "of one sensor, each exposure a file of its own; of reduced recordings FITS "
                "files hold LSST's photon transfer datasets only"
            )
        if found is None:
            raise RecordingError(
                f"{path}: no covariances, a_ij, spots, profile or photon transfer dataset"
            )
        return (found,)
    if not path.is_dir():
        return ()
    files = sorted(one for one in path.iterdir() if one.suffix in (".ecsv", ".csv"))
    files += [one for one in list_files(path) if _is_photon_transfer(one)]
    out = []
    for one in files:
        if one.name == "manifest.ecsv":
            continue
        found = _read_known(one)
        if found is not None:
            out.append(found)
    return tuple(out)


def holds_images(folder: Path) -> bool:
    """Whether a folder has FITS files that are no reduced recordings."""
    return any(not _is_photon_transfer(one) for one in list_files(folder))


def _read_known(path: Path) -> Reduced | None:
    """Read a file by what its columns are; None where they are not known."""
    if is_fits(path.name):
        return read_covariances(path) if _is_photon_transfer(path) else None
    if path.suffix not in (".ecsv", ".csv"):
        return read_profile(path) if path.suffix in (".txt", ".dat") else None
    table = _read_text(path)
    names = set(table.colnames)
    if str(table.meta.get("OBSTYPE", "")) == "PTC" or {"i", "j", "cov"} <= names:
        return read_covariances(path)
    if {"i_serial", "j_parallel", "cov_per_e", "err_per_e"} <= names:
        return read_area_changes(path)
    if {"radius", "value"} <= names:
        return read_profile(path)
    sized = any(
        {a, b} <= names for a, b in (("sigma_x", "sigma_y"), ("sigma_x_pix", "sigma_y_pix"))
    )
    if (sized or "T" in names) and names & {"flux", "total_e", "flux_e", "peak", "peak_e"}:
        return read_spots(path)
    return None


def _is_photon_transfer(path: Path) -> bool:
    """Whether a FITS file is LSST's photon transfer dataset, by its first table's header."""
    from astropy.io import fits

    from bfsensor.recording.raw.open_fits import open_fits

    if path.stat().st_size < 2880 * 2:
        return False
    try:
        with open_fits(path) as hdus:
            return (
                len(hdus) > 1
                and isinstance(hdus[1], fits.BinTableHDU)
                and str(hdus[1].header.get("OBSTYPE", "")).strip() == "PTC"
            )
    except (RecordingError, ValueError, TypeError, KeyError):
        return False


def _read_text(path: Path) -> Table:
    try:
        return text_tables.read(
            path, format="ecsv" if path.suffix == ".ecsv" else "csv", comment="#"
        )
    except (OSError, ValueError, InconsistentTableError) as error:
        line = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: cannot be read: {line}") from None
