"""A camera's a_ij from a file of them, or of the covariances of its flats at one level or more."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.errors import MeasurementError, RecordingError
from bfsensor.measure.bartlett import image_weights
from bfsensor.measure.covariance_fit import SCHEMA, CovarianceFit
from bfsensor.measure.covariance_model import model_covariances
from bfsensor.recording.raw.headers import is_fits
from bfsensor.recording.tables.area_changes import read_area_changes
from bfsensor.recording.tables.calibration_tables import require
from bfsensor.recording.tables.covariance_tables import warn_of_axes
from bfsensor.recording.tables.measured import area_changes_of_amplifiers
from bfsensor.recording.tables.text_tables import (
    LARGEST_LAG,
    floats,
    read_text,
    whole_numbers,
)
from bfsensor.typing import FloatArray

AREAS = (
    ("i_serial", "j_parallel", "cov_per_e", "err_per_e"),
    ("i", "j", "a", "error"),
)
"""Columns of tables of a_ij: lags in x and y, value and standard error [1/e-]."""

COVARIANCES = ("lag_x", "lag_y", "level", "covariance", "error")
"""Columns of tables of covariances, as `bfsensor measure flats -o` writes them."""

OTHER_NAMES = {
    "i": "lag_x", "j": "lag_y", "mu_e": "level", "cov": "covariance", "sigma": "error",
    "amp": "amplifier", "mu_adu": "level",
}  # fmt: skip
"""Names in other tables of covariances, and what they are called here."""

_ROUNDS = 20
"""Largest number of rounds in which the higher powers of the level are taken off the covariances.

Chosen: each round divides the change of a_ij by about 1 / (a_00 level), above 3 below full well; at
twice as many a level that does not settle is found out later."""

_SETTLED = 1e-4
"""Largest change of an a_ij in its errors at which the rounds end.

Chosen: twice as large changes no digit of what is printed."""


@dataclass(frozen=True, eq=False)
class CameraAreas:
    """Measured a_ij of a camera, by lag from (0, 0).

    Attributes
    ----------
    a, errors : ndarray, shape (n, n)
        Relative change of a pixel's area per electron and its standard error, ``[j, i]`` with i the
        lag in x (serial) and j that in y (parallel) [1/e-]; nan where not measured.
    used : ndarray of bool, shape (n, n)
        Lags that can be fitted: measured, and not computed from the others.
    source : str
        File, and how the a_ij follow from it.
    notes : tuple of str
        Warnings about axes, sums, and what a level cannot say.
    matrix : ndarray, shape (n^2, n^2), or None
        Covariance matrix of ``a.ravel()`` [1/e-^2]; None where only errors are known.
    """

    a: FloatArray
    errors: FloatArray
    used: NDArray[np.bool_]
    source: str
    notes: tuple[str, ...] = ()
    matrix: FloatArray | None = None

    def transposed(self) -> CameraAreas:
        """Return the same a_ij with x and y exchanged."""
        n = len(self.a)
        order = np.arange(n * n).reshape(n, n).T.ravel()
        return dataclasses.replace(
            self, a=self.a.T.copy(), errors=self.errors.T.copy(), used=self.used.T.copy(),
            source=f"{self.source}, axes exchanged",
            matrix=None if self.matrix is None else self.matrix[np.ix_(order, order)],
        )  # fmt: skip

    def select(self, *, lags: int, without: Sequence[tuple[int, int]] = ()) -> CameraAreas:
        """Keep lags up to a largest one, and leave single lags (i, j) out of the fit.

        Parameters
        ----------
        lags : int
            Largest lag [pixel], at least 1.
        without : sequence of (i, j)
            Lags in x and y that are not fitted.

        Returns
        -------
        areas : CameraAreas

        Raises
        ------
        MeasurementError
            A lag that is left out was not measured.
        """
        n = min(lags + 1, len(self.a))
        used = self.used[:n, :n].copy()
        for i, j in without:
            if not (0 <= i < n and 0 <= j < n and np.isfinite(self.a[j, i])):
                raise MeasurementError(
                    f"lag {i},{j} is not among the measured ones up to {n - 1}"
                )
            used[j, i] = False
        keep = np.arange(len(self.a) ** 2).reshape(self.a.shape)[:n, :n].ravel()
        matrix = None if self.matrix is None else self.matrix[np.ix_(keep, keep)]
        return dataclasses.replace(
            self, a=self.a[:n, :n], errors=self.errors[:n, :n], used=used, matrix=matrix
        )


def read_camera_areas(path: str | os.PathLike[str]) -> CameraAreas:
    r"""Read a_ij, or covariances of flats from which a_ij follow.

    Parameters
    ----------
    path : path-like
        Comma-separated or ECSV table with a row for each lag; lines that begin with # are comments.
        i counts pixels along a row (x, serial), j along a column (y, parallel), both from 0, as in
        LSST's datasets.  One of these sets of columns:

        - ``i, j, a, error`` or ``i_serial, j_parallel, cov_per_e, err_per_e`` [1/e-];
        - ``i, j, mu_e, cov, sigma`` [e-, e-^2], or ``mu_adu`` and ``gain`` [e-/ADU] with ``cov`` and
          ``sigma`` in ADU^2: covariances of one flat at a level or more, optionally by ``amp``;
        - ``lag_x, lag_y, level, covariance, error``, as ``bfsensor measure flats -o`` writes them.

        Or the file of a :class:`~bfsensor.measure.covariance_fit.CovarianceFit`, or LSST's photon
        transfer dataset.

    Returns
    -------
    areas : CameraAreas
        a_ij with errors.

    Raises
    ------
    RecordingError
        The file cannot be read, is of none of these kinds, or has a value that cannot be used.
    MeasurementError
        Levels too high for the series in the level.

    Examples
    --------
    >>> import tempfile
    >>> text = "i,j,mu_e,cov,sigma\n1,0,30000,135.0,9\n0,1,30000,270.0,9\n1,1,30000,90.0,9\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "covariances.csv"
    ...     _ = path.write_text(text)
    ...     areas = read_camera_areas(path)
    >>> areas.a.shape, int(areas.used.sum()), bool(1.4e-7 < areas.a[0, 1] < 1.6e-7)
    ((2, 2), 3, True)
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    if is_fits(path.name):
        return _of_amplifiers(path)
    table = read_text(path)
    if str(table.meta.get("OBSTYPE", "")).strip() == "PTC":
        return _of_amplifiers(path)
    if table.meta.get("schema") == SCHEMA:
        return _of_fit(path)
    names = set(table.colnames)
    for columns in AREAS:
        if set(columns) <= names:
            found = read_area_changes(path, columns=columns)
            return _square(
                found.a,
                found.errors,
                found.independent,
                f"{path.name}, a_ij",
                found.warnings,
            )
    for old, new in OTHER_NAMES.items():
        if old in table.colnames and new not in table.colnames:
            table.rename_column(old, new)
            if old == "mu_adu":
                _to_electrons(path, table)
    if not {"covariance", "lag_x", "lag_y"} <= set(table.colnames):
        raise RecordingError(
            f"{path}: neither a_ij (columns {', '.join(AREAS[1])} or {', '.join(AREAS[0])}) nor "
            f"covariances (i, j, mu_e, cov, sigma or {', '.join(COVARIANCES)}); its columns are "
            f"{', '.join(sorted(names))}"
        )
    return _of_covariances(path, table)


def _of_amplifiers(path: Path) -> CameraAreas:
    """Mean a_ij of the amplifiers of LSST's photon transfer dataset."""
    found = area_changes_of_amplifiers(path)
    source = f"{path.name}, mean A_MATRIX of the amplifiers"
    return _square(found.a, found.errors, found.independent, source, found.warnings)


def _of_fit(path: Path) -> CameraAreas:
    """a_ij and their covariance matrix from a fit of the covariance model."""
    found = CovarianceFit.read(path)
    size = found.a.size
    one = _square(
        found.a, found.a_errors, np.ones(found.a.shape, bool), f"{path.name}, fit", ()
    )
    return dataclasses.replace(one, matrix=found.matrix[:size, :size])


def _to_electrons(path: Path, table: Table) -> None:
    """Convert level and covariances from ADU with the column gain [e-/ADU], in place."""
    require(str(path), table.colnames, ("gain",))
    gain = floats(path, table, "gain")
    if not np.all(gain > 0):
        raise RecordingError(f"{path}: gain must be above 0 e-/ADU in every row")
    for name, power in (
        ("level", 1),
        ("covariance", 2),
        ("cov", 2),
        ("error", 2),
        ("sigma", 2),
    ):
        if name in table.colnames:
            table[name] = floats(path, table, name) * gain**power


def _square(
    a: FloatArray,
    errors: FloatArray,
    used: NDArray[np.bool_],
    source: str,
    notes: Sequence[str],
) -> CameraAreas:
    """Fill up to a square with nan, and refuse values that cannot be fitted."""
    n = max(a.shape)
    full = [np.full((n, n), np.nan), np.full((n, n), np.nan)]
    for one, given in zip(full, (a, errors), strict=True):
        one[: a.shape[0], : a.shape[1]] = given
    good = np.zeros((n, n), bool)
    good[: a.shape[0], : a.shape[1]] = used
    good &= np.isfinite(full[0])
    wrong = good & ~(full[1] > 0)
    if wrong.any():
        j, i = np.argwhere(wrong)[0]
        raise RecordingError(
            f"{source}: the error of lag {i},{j} is {full[1][j, i]:g}; errors must be above 0 and "
            "finite"
        )
    return CameraAreas(full[0], full[1], good, source, tuple(n for n in notes if n))


def _of_covariances(path: Path, table: Table) -> CameraAreas:
    r"""Solve C_ij = n_ij + delta_ij m + a_ij m^2 + ... for a_ij, the same at all levels.

    The powers of the level above the second follow from the a_ij themselves and are taken off in
    rounds.  The noise n_00 is free for each amplifier where there are levels enough, and a_00 is not
    fitted later where there are not.
    """
    require(str(path), table.colnames, COVARIANCES)
    units = set(map(str, table["unit"])) if "unit" in table.colnames else {"electron"}
    if units != {"electron"}:
        raise RecordingError(
            f"{path}: its covariances are in {', '.join(sorted(units))}, not electrons: measure "
            "them again with --gain"
        )
    i, j = (whole_numbers(path, table, name, most=LARGEST_LAG) for name in COVARIANCES[:2])
    level, value, error = (floats(path, table, name) for name in COVARIANCES[2:])
    for name, one in zip(COVARIANCES[2:], (level, value, error), strict=True):
        if not np.all(np.isfinite(one)):
            raise RecordingError(f"{path}: {name} holds values that are not finite")
    if not np.all(error > 0) or not np.all(level > 0):
        raise RecordingError(f"{path}: levels and errors must be above 0")
    amplifier = (
        np.array(list(map(str, table["amplifier"])))
        if "amplifier" in table.colnames
        else np.full(len(table), "all")
    )
    n = int(max(i.max(), j.max())) + 1
    a, errors, chi2, free = np.zeros((n, n)), np.full((n, n), np.nan), 0.0, 0
    too_high = MeasurementError(
        f"{path}: a_ij do not settle: levels up to {level.max():.0f} e- are too high for the series "
        "in the level; leave out those above half of the full well"
    )
    variances = bool(np.any((i == 0) & (j == 0)))
    for _ in range(_ROUNDS):
        if not variances:  # charge is conserved: all lags add up to 0
            a[0, 0] = 0.0
            a[0, 0] = -(image_weights(n - 1) * a).sum()
        model = model_covariances(np.unique(level), a)
        at = np.searchsorted(np.unique(level), level)
        # What is left is a_ij m^2 and the noise.
        rest = value - model[at, j, i] + a[j, i] * level**2
        before = a.copy()
        chi2, free = 0.0, 0
        for lag in set(zip(i.tolist(), j.tolist(), strict=True)):
            rows = (i == lag[0]) & (j == lag[1])
            found = _line(
                level[rows], rest[rows], error[rows], amplifier[rows], lag == (0, 0)
            )
            a[lag[1], lag[0]], errors[lag[1], lag[0]] = found[:2]
            chi2, free = chi2 + found[2], free + found[3]
        known = np.isfinite(errors)
        if np.abs(a).max() * level.max() > 1:  # an area would vanish: the series diverges
            raise too_high
        if np.max(np.abs(a - before)[known] / errors[known]) < _SETTLED:
            break
    else:
        raise too_high
    notes = []
    if free and chi2 > free:
        errors *= np.sqrt(chi2 / free)
        notes.append(
            f"levels differ by more than their errors, chi2/n {chi2 / free:.3g}: errors of a_ij "
            "times its root"
        )
    used = np.isfinite(errors)
    several = len(np.unique(level)) > len(set(amplifier.tolist())) + 1
    if used[0, 0] and not several:
        used[0, 0] = False
        notes.append(
            "a_00 is not fitted: variances at so few levels hold the read noise and the error of "
            "the gain too"
        )
    a[~np.isfinite(errors)] = np.nan
    if n > 1:
        notes.append(warn_of_axes(float(a[0, 1]), float(a[1, 0])))
    source = (
        f"{path.name}, covariances at {len(np.unique(level))} levels, {level.min():.0f} to "
        f"{level.max():.0f} e-"
    )
    return _square(a, errors, used, source, notes)


def _line(
    level: FloatArray,
    rest: FloatArray,
    error: FloatArray,
    amplifier: NDArray[np.str_],
    variance: bool,
) -> tuple[float, float, float, int]:
    """Fit a m^2, and for variances a noise for each amplifier: a, its error, chi2, n - parameters."""
    columns = [level**2]
    names = np.unique(amplifier)
    if variance and len(np.unique(level)) > len(names) + 1:
        columns += [(amplifier == name).astype(float) for name in names]
    design = np.array(columns).T / error[:, None]
    scale = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / scale)
    found = inverse @ (rest / error) / scale
    spread = np.linalg.norm(inverse, axis=1)[0] / scale[0]
    pulls = rest / error - design @ found
    return float(found[0]), float(spread), float(pulls @ pulls), len(level) - len(columns)
