"""Tables of flats' covariances by amplifier, level and lag, from ECSV or LSST's datasets."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.tables.calibration_tables import read_tables, require, write_tables
from bfsensor.recording.tables.lsst_datasets import PhotonTransferDataset
from bfsensor.recording.tables.text_tables import (
    LARGEST_LAG,
    floats,
    numbers,
    refuse_misspelt,
    whole_numbers,
)
from bfsensor.typing import FloatArray

KIND = "bfsensor covariance table"
"""Value of the header entry ``kind`` in files that :meth:`CovarianceTable.write` makes."""

COLUMNS = ("amp", "mu_e", "mu_adu", "gain", "i", "j", "cov", "sigma", "npix", "npair", "wavelength",
           "vbb", "matrix")  # fmt: skip
"""Columns of a table of covariances, by the names that are read."""

UNIT_RANGE = (0.8, 1.25)
"""Range of C_00 over the level [e-] of an amplifier's dimmest flats without a warning.

Poisson's statistics give 1, which the brighter-fatter effect lowers by a few percent and read noise
raises.  Chosen: variances of differences, not halved, and gains wrong by 2 are outside.  If the range
were twice as wide, 0.64 to 1.56, a gain wrong by 1.5 would pass.
"""

AXES_REMARK = (
    "exchanged axes cannot be seen in one table: compare with spots or with an overscan"
)
"""Advice in the warning of :func:`warn_of_axes`."""


@dataclass(frozen=True, eq=False)
class CovarianceTable:
    """Covariances of flats by amplifier, level and lag, in electrons.

    Attributes
    ----------
    path : Path
        File of the table.
    amplifier : ndarray of str, shape (n,)
        Name of the amplifier of each covariance.
    level : ndarray, shape (n,)
        Mean of the flats [e-].
    lag_x, lag_y : ndarray of int, shape (n,)
        Lags i along x (serial) and j along y (parallel) [pixel].
    covariance, error : ndarray, shape (n,)
        Covariance of one flat, not of a difference, and its standard error [e-^2].
    pixels, pairs : ndarray of int, shape (n,)
        Numbers of pairs of pixels and of pairs of flats; 0 where the file has none.
    wavelength, back_bias : ndarray, shape (n,)
        Wavelength [nm] and back bias [V]; nan where the file has none.
    matrix : ndarray, shape (n, n), or None
        Covariance matrix of the rows [e-^4]; None where only errors are known.
    warnings : tuple of str
        Warnings about errors, units and axes.

    Examples
    --------
    :func:`read_covariances` makes one; its example shows rows and warnings.
    """

    path: Path
    amplifier: NDArray[np.str_]
    level: FloatArray
    lag_x: NDArray[np.int64]
    lag_y: NDArray[np.int64]
    covariance: FloatArray
    error: FloatArray
    pixels: NDArray[np.int64]
    pairs: NDArray[np.int64]
    wavelength: FloatArray
    back_bias: FloatArray
    matrix: FloatArray | None = None
    warnings: tuple[str, ...] = field(default=())

    @property
    def what(self) -> str:
        """Kind, number of rows, amplifiers, levels and largest lags, in one line."""
        names = sorted(set(self.amplifier.tolist()))
        return (
            f"covariances, {len(self.level)} rows, {len(names)} amplifiers, "
            f"{len(np.unique(self.level))} levels from {self.level.min():.0f} to "
            f"{self.level.max():.0f} e-, lags to {self.lag_x.max()}, {self.lag_y.max()}"
        )

    def error_matrix(self) -> FloatArray:
        """Give the covariance matrix of the rows, diagonal where only errors are known.

        Returns
        -------
        matrix : ndarray, shape (n, n)
            Covariance matrix [e-^4].
        """
        return np.diag(self.error**2) if self.matrix is None else self.matrix

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write ECSV with the columns amp, mu_e, i, j, cov, sigma, npix, npair, wavelength, vbb.

        Parameters
        ----------
        path : path-like
            File to write, with the ending .ecsv.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        RecordingError
            The file exists and ``overwrite`` is False, or cannot be written.
        """
        table = Table(
            {
                "amp": self.amplifier, "mu_e": self.level, "i": self.lag_x, "j": self.lag_y,
                "cov": self.covariance, "sigma": self.error, "npix": self.pixels,
                "npair": self.pairs, "wavelength": self.wavelength, "vbb": self.back_bias,
            },
            units={"mu_e": "electron", "cov": "electron2", "sigma": "electron2",
                   "wavelength": "nm", "vbb": "V"},
        )  # fmt: skip
        if self.matrix is not None:
            table["matrix"] = self.matrix
        table.meta = {"kind": KIND, "unit": "electron", "difference": False}
        write_tables(path, [table], overwrite=overwrite)


def read_covariances(path: str | os.PathLike[str]) -> CovarianceTable:
    """Read covariances of flats from ECSV, or from LSST's PhotonTransferCurveDataset.

    Parameters
    ----------
    path : path-like
        ECSV with the columns i, j (lags along x and y), cov, sigma (its standard error) and mu_e,
        the level [e-] (or mu_adu [ADU]: then a column or header entry ``gain`` [e-/ADU]), and
        optionally amp, npix, npair, wavelength [nm], vbb [V], matrix.  Its header may state
        ``unit`` of cov and sigma, 'electron' (squared, the default) or 'adu', and ``difference``,
        true where cov is that of the difference of two flats.  Or LSST's dataset, FITS or ECSV.

    Returns
    -------
    table : CovarianceTable
        The covariances in electrons, with warnings.

    Raises
    ------
    RecordingError
        The file cannot be read, a column, gain or unit is missing, or a value is not finite.

    Notes
    -----
    By Poisson's statistics C_00 of the dimmest flats equals their level.  A warning reports an
    amplifier where it differs by more than 20 %, with the likely cause.

    Examples
    --------
    >>> import tempfile
    >>> rows = [(0, 0, 5e3, 4.9e3, 20.0), (1, 0, 5e3, 3.0, 1.0), (0, 1, 5e3, 7.0, 1.0)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "covariances.ecsv"
    ...     Table(rows=rows, names=("i", "j", "mu_e", "cov", "sigma")).write(path)
    ...     table = read_covariances(path)
    >>> table.covariance.tolist(), len(table.warnings)
    ([4900.0, 3.0, 7.0], 1)
    """
    path = Path(path)
    table = read_tables(path)[0]
    if str(table.meta.get("OBSTYPE", "")).strip() == "PTC":
        return from_photon_transfer(PhotonTransferDataset.read(path), path)
    refuse_misspelt(path, table.colnames, COLUMNS)
    refuse_misspelt(path, map(str, table.meta), ("gain", "unit", "difference"))
    require(str(path), table.colnames, ("i", "j", "cov"))
    n = len(table)
    gain = _gain(path, table)
    if "mu_e" in table.colnames:
        level = numbers(path, table, "mu_e", above=0.0)
    elif "mu_adu" in table.colnames:
        level = numbers(path, table, "mu_adu", above=0.0) * gain
    else:
        raise RecordingError(
            f"{path}: no column of the level, mu_e [e-] or mu_adu [ADU] with a gain"
        )
    unit = str(table.meta.get("unit", "electron"))
    if unit not in ("electron", "adu"):
        raise RecordingError(f"{path}: unit = {unit!r} is not 'electron' or 'adu'")
    factor = gain**2 if unit == "adu" else np.ones(n)
    difference = table.meta.get("difference", False)
    if not isinstance(difference, bool):
        raise RecordingError(
            f"{path}: header entry difference = {str(difference)[:80]!r} is not true or false"
        )
    factor = factor / 2 if difference else factor
    warnings = []
    if "sigma" in table.colnames:
        error = floats(path, table, "sigma") * factor
    else:
        raise RecordingError(
            f"{path}: sigma missing, the standard errors of cov, without which it cannot be fitted"
        )
    matrix = None
    if "matrix" in table.colnames:
        matrix = np.asarray(table["matrix"], float)
        if matrix.shape != (n, n):
            raise RecordingError(
                f"{path}: matrix has the shape {matrix.shape}, not {(n, n)}"
            )
        matrix = matrix * factor[:, None] * factor[None, :]
    else:
        warnings.append(
            "no covariance matrix: rows are taken as independent, and chi-square is too large or "
            "too small by the errors that they share; a column matrix states it"
        )
    names = table["amp"] if "amp" in table.colnames else ["all"] * n
    return _checked(
        CovarianceTable(
            path=path, amplifier=np.array([str(v) for v in names]), level=level,
            lag_x=whole_numbers(path, table, "i", most=LARGEST_LAG),
            lag_y=whole_numbers(path, table, "j", most=LARGEST_LAG),
            covariance=floats(path, table, "cov") * factor, error=error,
            pixels=whole_numbers(path, table, "npix"), pairs=whole_numbers(path, table, "npair"),
            wavelength=numbers(path, table, "wavelength", above=0.0, blank=True),
            back_bias=numbers(path, table, "vbb", blank=True),
            matrix=matrix, warnings=tuple(warnings),
        )
    )  # fmt: skip


def from_photon_transfer(dataset: PhotonTransferDataset, path: Path) -> CovarianceTable:
    """Convert LSST's dataset to a table in electrons, with the dataset's gains.

    Errors are those of the dataset's weights.  Without weights they are those of white noise:
    C_00 / sqrt(n) for n pixels, and sqrt(2) times that at lag (0, 0).

    Parameters
    ----------
    dataset : PhotonTransferDataset
        The dataset.
    path : Path
        Its file, for messages and for the table.

    Returns
    -------
    table : CovarianceTable
        Covariances of the pairs that the pipeline kept.

    Raises
    ------
    RecordingError
        No amplifier has a gain, or an amplifier has neither weights nor a number of pixels.
    """
    parts: dict[str, list[ArrayLike]] = {}
    white = False
    lost = []
    for name in dataset.amplifiers:
        k = dataset.row(name)
        gain = float(np.atleast_1d(dataset.columns["GAIN"][k])[0])
        if not (np.isfinite(gain) and gain > 0):
            lost.append(name)
            continue
        curve = dataset.curve(name)
        c = np.asarray(curve["covariances"]) * gain**2
        weights = dataset.columns.get("COVARIANCES_SQRT_WEIGHTS")
        pixels = int(curve.get("pixels", 0))
        kept = dataset.pairs_kept(name)
        w = np.zeros_like(c)
        if weights is not None and len(weights[k]) == len(kept):
            w = weights[k][kept]
        if w.shape == c.shape and np.all(w > 0):
            error = gain**2 / w
        elif pixels:
            white = True
            error = np.repeat(c[:, :1, :1] / np.sqrt(pixels), c.shape[1], 1)
            error = np.repeat(error, c.shape[2], 2)
            error[:, 0, 0] *= np.sqrt(2)
        else:
            raise RecordingError(
                f"{path}: {name}: no errors: neither COVARIANCES_SQRT_WEIGHTS above 0 nor "
                "NPIXEL_COVARIANCES"
            )
        levels, j, i = np.meshgrid(
            np.asarray(curve["levels"]) * gain, np.arange(c.shape[1]),
            np.arange(c.shape[2]), indexing="ij",
        )  # fmt: skip
        for key, value in (
            ("amplifier", np.full(c.size, name)), ("level", levels.ravel()),
            ("lag_x", i.ravel()), ("lag_y", j.ravel()), ("covariance", c.ravel()),
            ("error", error.ravel()), ("pixels", np.full(c.size, pixels)),
        ):  # fmt: skip
            parts.setdefault(key, []).append(value)
    if not parts:
        raise RecordingError(
            f"{path}: no amplifier has a GAIN above 0, which electrons need"
        )
    columns: dict[str, Any] = {name: np.concatenate(v) for name, v in parts.items()}
    n = len(columns["level"])
    warnings = ["no covariance matrix: rows are taken as independent"]
    if white:
        warnings.append("no COVARIANCES_SQRT_WEIGHTS: errors are those of white noise")
    if lost:
        warnings.append(f"no gain for {', '.join(lost)}: left out")
    return _checked(
        CovarianceTable(
            path=path, **columns, pairs=np.ones(n, np.int64),
            wavelength=np.full(n, np.nan), back_bias=np.full(n, np.nan),
            warnings=tuple(warnings),
        )
    )  # fmt: skip


def _checked(table: CovarianceTable) -> CovarianceTable:
    """Refuse values that are not finite and errors of 0; add warnings about units and axes."""
    from dataclasses import replace

    for name in ("level", "covariance", "error"):
        wrong = ~np.isfinite(getattr(table, name))
        if wrong.any():
            raise RecordingError(
                f"{table.path}: {wrong.sum()} rows of {name} are not finite; leave them out"
            )
    if np.any(table.error <= 0):
        raise RecordingError(f"{table.path}: errors must be above 0")
    warnings = list(table.warnings)
    for name in dict.fromkeys(table.amplifier.tolist()):
        here = (table.amplifier == name) & (table.lag_x == 0) & (table.lag_y == 0)
        if not here.any():
            continue
        k = np.flatnonzero(here)[np.argmin(table.level[here])]
        ratio = (
            float(table.covariance[k] / table.level[k]) if table.level[k] > 0 else np.nan
        )
        # Below 300 e- the read noise of some sensors is as large as the shot noise.
        if table.level[k] > 300 and not UNIT_RANGE[0] <= ratio <= UNIT_RANGE[1]:
            warnings.append(
                f"{name}: C_00 over the level is {ratio:.3g} at {table.level[k]:.0f} e-, where it "
                f"should be near 1: {_meaning(ratio)}"
            )
    at = {}
    for lag in ((1, 0), (0, 1)):
        here = (table.lag_x == lag[0]) & (table.lag_y == lag[1])
        at[lag] = float(np.mean(table.covariance[here])) if here.any() else np.nan
    warnings.append(warn_of_axes(at[1, 0], at[0, 1]))
    return replace(table, warnings=tuple(w for w in warnings if w))


def _meaning(ratio: float) -> str:
    """Name the likely cause of a wrong ratio of variance and level."""
    if 1.6 < ratio < 2.4:
        return "of a difference of two flats (header entry difference: true), or a gain wrong by 2?"
    if 0.4 < ratio < 0.6:
        return "halved twice, or a gain wrong by 2?"
    return "a wrong gain, or ADU taken for electrons (header entry unit: adu)?"


def warn_of_axes(x: float, y: float) -> str:
    """Warning where the neighbour in x gains more than that in y; '' otherwise."""
    if not x > y:
        return ""
    return (
        f"lag (1, 0) is larger than (0, 1), {x:.3g} and {y:.3g}: thick CCDs have it the other way "
        f"unless the serial register adds to it, so x and y may be exchanged; {AXES_REMARK}"
    )


def _gain(path: Path, table: Table) -> FloatArray:
    """Gain of each row [e-/ADU]; nan without one, which is an error for values in ADU."""
    if "gain" in table.colnames:
        return numbers(path, table, "gain", above=0.0)
    value = table.meta.get("gain")
    needed = "mu_e" not in table.colnames or table.meta.get("unit") == "adu"
    if value is None and needed:
        raise RecordingError(
            f"{path}: in ADU, and no gain [e-/ADU] in a column or header entry gain"
        )
    if value is None:
        return np.full(len(table), np.nan)
    number = (
        value if isinstance(value, int | float) and not isinstance(value, bool) else np.nan
    )
    if not 0 < number < np.inf:
        raise RecordingError(
            f"{path}: header entry gain = {str(value)[:80]!r} must be a number above 0 e-/ADU"
        )
    return np.full(len(table), float(number))
