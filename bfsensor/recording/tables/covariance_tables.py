"""Covariances that others measured: our ECSV table and LSST's datasets."""

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
from bfsensor.typing import FloatArray

KIND = "bfsensor covariance table"

UNIT_RANGE = (0.8, 1.25)
"""C_00 over the level of the dimmest flats that passes: Poisson's 1, less the effect."""

AXES_REMARK = "exchanged axes cannot be seen in one table: compare with the spots, or with an overscan"


@dataclass(frozen=True, eq=False)
class CovarianceTable:
    """Covariances of flats by amplifier, level and lag, in electrons.

    Attributes
    ----------
    path : Path
        Where they came from.
    amplifier : ndarray of str, shape (n,)
        A row for each covariance.
    level : ndarray, shape (n,)
        Mean of the flats [e-].
    lag_x, lag_y : ndarray of int, shape (n,)
        i along x, serial, and j along y, parallel.
    covariance, error : ndarray, shape (n,)
        Of one flat, not of a difference [e-^2].
    pixels, pairs : ndarray of int, shape (n,)
        Pairs of pixels and of flats; 0 where not said.
    wavelength, back_bias : ndarray, shape (n,)
        [nm], [V]; nan where not said.
    matrix : ndarray, shape (n, n), or None
        Covariance matrix of the rows [e-^4]; None where only errors are known.
    warnings : tuple of str
        What a reader should know.
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
        """One line for a list."""
        names = sorted(set(self.amplifier.tolist()))
        return (
            f"covariances, {len(self.level)} rows, {len(names)} amplifiers, "
            f"{len(np.unique(self.level))} levels from {self.level.min():.0f} to "
            f"{self.level.max():.0f} e-, lags to {self.lag_x.max()}, {self.lag_y.max()}"
        )

    def error_matrix(self) -> FloatArray:
        """Covariance matrix of the rows, diagonal where only errors are known [e-^4]."""
        return np.diag(self.error**2) if self.matrix is None else self.matrix

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write ECSV: amp, mu_e, i, j, cov, sigma, npix, npair, wavelength, vbb.

        Raises
        ------
        RecordingError
            The file exists and ``overwrite`` is not set, or cannot be written.
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
    """Read covariances of flats: our ECSV, or LSST's PhotonTransferCurveDataset.

    Parameters
    ----------
    path : path-like
        ECSV with the columns i, j, cov and mu_e (or mu_adu: then a column or header entry
        ``gain``), and amp, sigma, npix, npair, wavelength, vbb, matrix where known.  Header:
        ``unit`` of cov, 'electron' (squared) or 'adu'; ``difference``, true where cov is of
        the difference of two flats.  Or LSST's dataset, FITS or ECSV.

    Returns
    -------
    table : CovarianceTable

    Raises
    ------
    RecordingError
        A column, gain or unit is missing, or a value is not finite.

    Notes
    -----
    C_00 of the dimmest flats must be their level, by Poisson's statistics: what is off by
    more than 20 % is named, with what the ratio stands for.
    """
    path = Path(path)
    table = read_tables(path)[0]
    if str(table.meta.get("OBSTYPE", "")).strip() == "PTC":
        return from_photon_transfer(PhotonTransferDataset.read(path), path)
    require(str(path), table.colnames, ("i", "j", "cov"))
    n = len(table)
    gain = _gain(path, table)
    if "mu_e" in table.colnames:
        level = floats(table, "mu_e")
    elif "mu_adu" in table.colnames:
        level = floats(table, "mu_adu") * gain
    else:
        raise RecordingError(f"{path}: mu_e (or mu_adu with a gain) missing")
    unit = str(table.meta.get("unit", "electron"))
    if unit not in ("electron", "adu"):
        raise RecordingError(f"{path}: unit = {unit!r} is not 'electron' or 'adu'")
    factor = gain**2 if unit == "adu" else np.ones(n)
    factor = factor / 2 if table.meta.get("difference", False) else factor
    warnings = []
    if "sigma" in table.colnames:
        error = floats(table, "sigma") * factor
    else:
        raise RecordingError(
            f"{path}: sigma missing: a covariance without error is refused"
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
            "too small by what they share"
        )
    names = table["amp"] if "amp" in table.colnames else ["all"] * n
    return _checked(
        CovarianceTable(
            path=path, amplifier=np.array([str(v) for v in names]), level=level,
            lag_x=whole_numbers(path, table, "i"), lag_y=whole_numbers(path, table, "j"),
            covariance=floats(table, "cov") * factor, error=error,
            pixels=whole_numbers(path, table, "npix"), pairs=whole_numbers(path, table, "npair"),
            wavelength=floats(table, "wavelength"), back_bias=floats(table, "vbb"),
            matrix=matrix, warnings=tuple(warnings),
        )
    )  # fmt: skip


def from_photon_transfer(dataset: PhotonTransferDataset, path: Path) -> CovarianceTable:
    """Turn LSST's dataset into a table in electrons, with its own gains.

    Errors are its weights', or where it has none those of white noise, C_00 / sqrt(n) for n
    pixels and sqrt(2) times that at lag (0, 0).

    Parameters
    ----------
    dataset : PhotonTransferDataset
        As its ``read`` gives it.
    path : Path
        Its file, which messages and the table name.

    Returns
    -------
    CovarianceTable

    Raises
    ------
    RecordingError
        No amplifier has a gain, or neither weights nor a number of pixels.
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
        kept = np.atleast_1d(dataset.columns["EXP_ID_MASK"][k]).astype(bool)
        usable = weights is not None and len(weights[k]) == len(kept)
        w = (
            weights[k][kept][: len(c)]
            if usable and weights is not None
            else np.zeros_like(c)
        )
        if w.shape == c.shape and np.all(w > 0):
            error = gain**2 / w
        elif pixels:
            white = True
            error = np.repeat(c[:, :1, :1] / np.sqrt(pixels), c.shape[1], 1)
            error = np.repeat(error, c.shape[2], 2)
            error[:, 0, 0] *= np.sqrt(2)
        else:
            raise RecordingError(f"{path}: {name}: neither weights nor NPIXEL_COVARIANCES")
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
        raise RecordingError(f"{path}: no amplifier has a gain")
    columns: dict[str, Any] = {name: np.concatenate(v) for name, v in parts.items()}
    n = len(columns["level"])
    warnings = ["no covariance matrix: rows are taken as independent"]
    if white:
        warnings.append("no weights: errors are those of white noise")
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
    """Refuse what cannot be used; add warnings about units and axes."""
    from dataclasses import replace

    for name in ("level", "covariance", "error"):
        wrong = ~np.isfinite(getattr(table, name))
        if wrong.any():
            raise RecordingError(
                f"{table.path}: {wrong.sum()} rows of {name} are not finite"
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
        # Read noise may be as large as the shot noise of a few hundred electrons.
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
    """Name the slip that a ratio of variance and level stands for."""
    if 1.6 < ratio < 2.4:
        return "of a difference of two flats, or a gain wrong by 2?"
    if 0.4 < ratio < 0.6:
        return "halved twice, or a gain wrong by 2?"
    return "a wrong gain, or ADU taken for electrons?"


def warn_of_axes(x: float, y: float) -> str:
    """Warn where the neighbour in x gains more than that in y; '' otherwise."""
    if not x > y:
        return ""
    return (
        f"lag (1, 0) is larger than (0, 1), {x:.3g} and {y:.3g}: thick CCDs have it the other way "
        f"unless the serial register adds to it, so x and y may be exchanged; {AXES_REMARK}"
    )


def _gain(path: Path, table: Table) -> FloatArray:
    """Gain of each row [e-/ADU]; nan where not said, an error where it is needed."""
    if "gain" in table.colnames:
        return floats(table, "gain")
    value = table.meta.get("gain")
    needed = "mu_e" not in table.colnames or table.meta.get("unit") == "adu"
    if value is None and needed:
        raise RecordingError(f"{path}: in ADU, and no gain in a column or the header")
    return np.full(len(table), np.nan if value is None else float(value))


def floats(table: Table, name: str) -> FloatArray:
    """Give a column as floats; nan where it is masked or not there."""
    if name not in table.colnames:
        return np.full(len(table), np.nan)
    return np.asarray(np.ma.filled(np.ma.asarray(table[name], float), np.nan), float)


def whole_numbers(path: Path, table: Table, name: str) -> NDArray[np.int64]:
    """Give a column as whole numbers; 0 where it is not there."""
    values = floats(table, name) if name in table.colnames else np.zeros(len(table))
    if not np.all(values == np.round(values)):
        raise RecordingError(f"{path}: {name} must be whole numbers")
    return values.astype(np.int64)
