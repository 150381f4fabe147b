"""Tables of a_ij that others measured."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import ascii as text_tables
from astropy.io.ascii import InconsistentTableError
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.tables.calibration_tables import require
from bfsensor.recording.tables.covariance_tables import floats, warn_of_axes, whole_numbers
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class AreaChangeTable:
    """Measured a_ij: relative change of the pixel's area per electron, by lag.

    Attributes
    ----------
    path : Path
        Where they came from.
    a, errors : ndarray, shape (ny, nx)
        [j, i], from lag (0, 0) [1/e-]; nan where not given.
    independent : ndarray of bool, shape (ny, nx)
        False at (0, 0) where it was set so that all lags add up to nothing.
    warnings : tuple of str
    """

    path: Path
    a: FloatArray
    errors: FloatArray
    independent: NDArray[np.bool_]
    warnings: tuple[str, ...] = ()

    @property
    def what(self) -> str:
        """One line for a list."""
        ny, nx = self.a.shape
        return f"a_ij, lags to {nx - 1}, {ny - 1}, a_00 = {self.a[0, 0]:.3e} per electron"


def read_area_changes(
    path: str | os.PathLike[str],
    *,
    columns: tuple[str, str, str, str] = (
        "i_serial",
        "j_parallel",
        "cov_per_e",
        "err_per_e",
    ),
) -> AreaChangeTable:
    """Read a table of a_ij, comma-separated or ECSV, lines with # passed over.

    Parameters
    ----------
    path : path-like
        The table.
    columns : tuple of str
        Names of the columns of the lag in x, the lag in y, the value and its error
        [1/e-]; by default those of the published ITL and E2V tables as they are kept here.
        A table with the axes the other way is read by exchanging the first two.

    Returns
    -------
    AreaChangeTable

    Raises
    ------
    RecordingError
        A column is missing, a lag is given twice or is no whole number.

    Notes
    -----
    Such tables are C_ij over C_00 and the level, or slopes of it: the flux range is the
    publisher's.  Where all lags, those of both signs counted, add up to less than a
    hundredth of the sum's error, a_00 was computed from the rest: it is no measurement.
    """
    path = Path(path)
    try:
        form = "ecsv" if path.suffix == ".ecsv" else "csv"
        table = text_tables.read(path, format=form, comment="#")
    except (OSError, ValueError, InconsistentTableError) as error:
        line = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: cannot be read: {line}") from None
    require(str(path), table.colnames, columns)
    i, j = (whole_numbers(path, table, name) for name in columns[:2])
    if min(i.min(), j.min()) < 0:
        raise RecordingError(f"{path}: lags below 0 are not read; average the quadrants")
    a = np.full((j.max() + 1, i.max() + 1), np.nan)
    errors = a.copy()
    if len(set(zip(i.tolist(), j.tolist(), strict=True))) < len(i):
        raise RecordingError(f"{path}: a lag is given twice")
    a[j, i], errors[j, i] = floats(table, columns[2]), floats(table, columns[3])
    times = np.where(np.arange(a.shape[1]) > 0, 2, 1) * np.where(
        np.arange(a.shape[0]) > 0, 2, 1
    )[:, None]  # fmt: skip
    total = np.nansum(times * a)
    scatter = np.sqrt(np.nansum((times * errors) ** 2))
    independent = np.isfinite(a)
    warnings = [warn_of_axes(float(a[0, 1]), float(a[1, 0]))] if min(a.shape) > 1 else []
    if abs(total) < 0.01 * scatter:
        independent[0, 0] = False
        warnings.append(
            f"all lags add up to {total:.1e}, with an error of {scatter:.1e}: a_00 was set by "
            "the sum and is not independent; charge conservation is not tested by this table"
        )
    return AreaChangeTable(path, a, errors, independent, tuple(w for w in warnings if w))
