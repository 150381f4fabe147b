"""Reduced recordings of any kind in a folder or file; tables of spots and radial profiles."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.manifest import list_files
from bfsensor.recording.raw.headers import is_fits
from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
from bfsensor.recording.tables.covariance_tables import (
    CovarianceTable,
    read_covariances,
)
from bfsensor.recording.tables.text_tables import numbers, read_text, refuse_misspelt
from bfsensor.typing import FloatArray

SPOT_COLUMNS = {
    "flux": ("flux", "total_e", "flux_e"), "peak": ("peak", "peak_e"),
    "sigma_x": ("sigma_x", "sigma_x_pix"), "sigma_y": ("sigma_y", "sigma_y_pix"),
    "size": ("T", "size"), "e1": ("e1",), "e2": ("e2",), "x": ("x",), "y": ("y",),
    "kurtosis": ("kurtosis",), "wavelength": ("wavelength",), "back_bias": ("vbb", "back_bias"),
}  # fmt: skip
"""Names of a spot table's columns by quantity, of which the first found is read.

Flux and peak [e-], sigma_x, sigma_y, x and y [pixel], size T = Ixx + Iyy [pixel^2], wavelength [nm],
back bias [V].
"""

POSITIVE = ("sigma_x", "sigma_y", "size", "wavelength")
"""Quantities of a spot table that are above 0."""

LABELS = ("amp", "amplifier", "segment", "state", "region")
"""Columns whose words divide a spot table into groups."""

ERROR_ENDS = ("error", "err", "sigma")
"""Ends of the names of columns of standard errors, after a _."""

_ADVICE = "; leave out spots that were not measured"


@dataclass(frozen=True, eq=False)
class SpotTable:
    """Sizes, shapes and positions of spots against their flux.

    Attributes
    ----------
    path : Path
        File of the table.
    values : mapping of str to ndarray, shape (n,)
        Values by quantity, with keys and units of :data:`SPOT_COLUMNS`.
    errors : mapping of str to ndarray, shape (n,)
        Standard errors of the quantities that have any.
    group : ndarray of str, shape (n,)
        Words of the label columns of each row, such as its amplifier, joined by blanks.
    warnings : tuple of str
        Warnings about missing errors and positions.

    Examples
    --------
    >>> sizes = {"flux": np.array([1e4, 2e5]), "size": np.array([2.1, 2.2])}
    >>> SpotTable(Path("spots.csv"), sizes, {}, np.array(["A", "A"])).what
    'spots, 2 rows, 1 groups, flux, size'
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
    """A quantity against the distance from the wafer's centre, as tree rings show it.

    Attributes
    ----------
    path : Path
        File of the profile.
    radius : ndarray, shape (n,)
        Distance from the centre of the rings [pixel], ascending.
    value, error : ndarray, shape (n,)
        Values and their standard errors [unit]; errors are nan where the file has none, rows
        without a value are left out.
    unit : str
        Unit of the values, as the caller or an ECSV file states it; '' where it is not known.
    warnings : tuple of str
        Warnings about missing errors, units and values.

    Examples
    --------
    >>> radius = np.arange(1000.0, 1100.0)
    >>> profile = RadialProfile(Path("r.txt"), radius, np.sin(radius), 0 * radius, "percent")
    >>> profile.what
    'radial profile, 100 rows from 1000 to 1099 pixels, rms 0.709 percent'
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
    r"""Read a table of spots, ECSV or comma-separated.

    Parameters
    ----------
    path : path-like
        Table with a column flux or peak [e-], and with sigma_x and sigma_y [pixel] or T
        [pixel^2]; a column NAME_error (or NAME_err, NAME_sigma) is the standard error of NAME.

    Returns
    -------
    table : SpotTable
        The spots, with warnings.

    Raises
    ------
    RecordingError
        The file cannot be read, or has no column of flux or of size.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "spots.csv"
    ...     _ = path.write_text("flux,sigma_x,sigma_y\n1e4,1.0,1.1\n2e5,1.1,1.2\n")
    ...     spots = read_spots(path)
    >>> spots.values["sigma_x"].tolist(), len(spots.warnings)
    ([1.0, 1.1], 2)
    """
    path = Path(path)
    table = read_text(path)
    values, errors = {}, {}
    words_of = [word for words in SPOT_COLUMNS.values() for word in words]
    ends = [f"{word}_{end}" for word in words_of for end in ERROR_ENDS]
    refuse_misspelt(path, table.colnames, [*words_of, *ends, *LABELS])
    for name, words in SPOT_COLUMNS.items():
        column = next((word for word in words if word in table.colnames), None)
        if column is None:
            continue
        low = 0.0 if name in POSITIVE else -np.inf
        values[name] = numbers(path, table, column, above=low, advice=_ADVICE)
        for end in ERROR_ENDS:
            if f"{column}_{end}" in table.colnames:
                errors[name] = numbers(
                    path, table, f"{column}_{end}", above=0.0, advice=_ADVICE
                )
    if not {"flux", "peak"} & set(values):
        raise RecordingError(
            f"{path}: no column flux or peak [e-] among {', '.join(table.colnames)}"
        )
    if not ({"sigma_x", "sigma_y"} <= set(values) or "size" in values):
        raise RecordingError(
            f"{path}: no columns sigma_x and sigma_y [pixel], nor T [pixel^2], among "
            f"{', '.join(table.colnames)}"
        )
    labels = [name for name in LABELS if name in table.colnames]
    group = np.array(
        [
            " ".join(
                "" if np.ma.is_masked(c := table[name][k]) else str(c) for name in labels
            )
            for k in range(len(table))
        ],
        str,
    )
    warnings = []
    sizes = [name for name in ("sigma_x", "sigma_y", "size") if name in values]
    if any(name not in errors for name in sizes):
        warnings.append(
            "sizes without errors: add a column such as sigma_x_error; the scatter about a fit "
            "against flux estimates them"
        )
    if "x" not in values or "y" not in values:
        warnings.append(
            "no positions (columns x and y): boundary shifts that differ between opposite sides "
            "of a pixel cannot be tested"
        )
    return SpotTable(path, values, errors, group, tuple(warnings))


def read_profile(path: str | os.PathLike[str], *, unit: str = "") -> RadialProfile:
    """Read a radial profile: columns of radius, value and, optionally, error.

    Parameters
    ----------
    path : path-like
        Numbers in two or three columns without names, or ECSV with the columns radius, value,
        error.
    unit : str
        Unit of the value, such as 'percent'; '' for the unit of an ECSV file's column.

    Returns
    -------
    profile : RadialProfile
        The rows that have a value, with warnings.

    Raises
    ------
    RecordingError
        The file does not have two or three columns of numbers, has fewer than ten values, or
        its radii do not ascend.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "rings.txt"
    ...     np.savetxt(path, np.c_[np.arange(20), np.cos(np.arange(20))])
    ...     profile = read_profile(path, unit="percent")
    >>> len(profile.radius), profile.warnings
    (20, ('no errors: the scatter between neighbouring rings estimates them',))
    """
    path = Path(path)
    if path.suffix == ".ecsv":
        table = read_text(path)
        refuse_misspelt(path, table.colnames, ("radius", "value", "error"))
        columns = [
            numbers(path, table, c, above=0.0 if c == "error" else -np.inf)
            for c in ("radius", "value", "error")
            if c in table.colnames
        ]
        unit = unit or str(table["value"].unit or "") if "value" in table.colnames else unit
    else:
        try:
            columns = list(np.loadtxt(path, ndmin=2, unpack=True))
        except (OSError, ValueError) as error:
            raise RecordingError(f"{path}: cannot be read: {error}") from None
    if len(columns) not in (2, 3):
        raise RecordingError(
            f"{path}: {len(columns)} columns, not two or three: radius, value and error"
        )
    radius, value = columns[:2]
    errors = columns[2] if len(columns) == 3 else np.full(len(radius), np.nan)
    kept = np.isfinite(radius) & np.isfinite(value)
    if kept.sum() < 10 or np.any(np.diff(radius[kept]) <= 0):
        raise RecordingError(
            f"{path}: a profile needs ten values at least, here {int(kept.sum())}, and radii that "
            "ascend: sort the rows by radius"
        )
    warnings = []
    if len(columns) == 2:
        warnings.append("no errors: the scatter between neighbouring rings estimates them")
    if not unit:
        warnings.append(
            "no unit: amplitudes can be compared with other such files only; an ECSV file may "
            "state the unit of its column value"
        )
    if not kept.all():
        warnings.append(f"{int((~kept).sum())} radii have no value and are left out")
    return RadialProfile(
        path, radius[kept], value[kept], errors[kept], unit, tuple(warnings)
    )


def find_reduced(path: str | os.PathLike[str]) -> tuple[Reduced, ...]:
    """Read the reduced recordings of a folder, or of one file.

    Kinds are recognised by their columns: covariances, a_ij, spots and profiles in ECSV (a_ij
    and spots also comma-separated), and LSST's photon transfer datasets in FITS.

    Parameters
    ----------
    path : path-like
        Folder, of which files of other kinds are ignored; or one file.

    Returns
    -------
    found : tuple of CovarianceTable, AreaChangeTable, SpotTable or RadialProfile
        The tables, sorted by file name; empty where a folder has none or does not exist.

    Raises
    ------
    RecordingError
        The one file is of none of these kinds, or a file of one of these kinds cannot be used.
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
                f"{path}: not a table of covariances (columns i, j, cov), a_ij (i_serial, "
                "j_parallel, cov_per_e, err_per_e), spots (flux, sigma_x, sigma_y), a profile "
                "(radius, value) or a photon transfer dataset, in .ecsv, .csv, .txt, .dat or FITS"
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
    """Whether a folder has FITS files other than LSST's photon transfer datasets."""
    return any(not _is_photon_transfer(one) for one in list_files(folder))


def _read_known(path: Path) -> Reduced | None:
    """Read a file of the kind that its columns show; None for files of other kinds."""
    if is_fits(path.name):
        return read_covariances(path) if _is_photon_transfer(path) else None
    if path.suffix not in (".ecsv", ".csv"):
        return read_profile(path) if path.suffix in (".txt", ".dat") else None
    table = read_text(path)
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
