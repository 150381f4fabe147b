"""Tables of measured a_ij, the relative change of pixel areas per electron."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.tables.calibration_tables import require
from bfsensor.recording.tables.covariance_tables import warn_of_axes
from bfsensor.recording.tables.text_tables import (
    LARGEST_LAG,
    numbers,
    read_text,
    whole_numbers,
)
from bfsensor.typing import FloatArray

_ADVICE = (
    "; leave out lags that were not measured, and average quadrants into i >= 0, j >= 0"
)


@dataclass(frozen=True, eq=False)
class AreaChangeTable:
    """Measured a_ij: relative change of the pixel's area per electron, by lag.

    Attributes
    ----------
    path : Path
        File of the table.
    a, errors : ndarray, shape (ny, nx)
        a_ij and their standard errors as ``a[j, i]``, from lag (0, 0) [1/e-]; nan where the
        table has no row.
    independent : ndarray of bool, shape (ny, nx)
        True where a value was measured; False at (0, 0) where a_00 was computed from the
        others so that all lags add up to 0.
    warnings : tuple of str
        Warnings about axes and the sum of all lags.

    Examples
    --------
    >>> a = np.array([[-2e-6, 1e-7], [3e-7, 5e-8]])
    >>> AreaChangeTable(Path("a.csv"), a, abs(a) / 10, np.isfinite(a)).what
    'a_ij, lags to 1, 1, a_00 = -2.000e-06 per electron'
    """

    path: Path
    a: FloatArray
    errors: FloatArray
    independent: NDArray[np.bool_]
    warnings: tuple[str, ...] = ()

    @property
    def what(self) -> str:
        """Kind, largest lags and a_00 of the table, in one line."""
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
    r"""Read a table of a_ij, comma-separated or ECSV; lines that begin with # are comments.

    Parameters
    ----------
    path : path-like
        The table, with a row for each lag of the quadrant i >= 0, j >= 0.
    columns : tuple of str
        Names of the columns of the lag in x (serial), the lag in y (parallel), the value and
        its standard error [1/e-]; by default those of the published ITL and E2V tables in this
        repository.  A table with exchanged axes is read by exchanging the first two names.

    Returns
    -------
    table : AreaChangeTable
        The values as [j, i], with warnings.

    Raises
    ------
    RecordingError
        The file cannot be read, a column is missing, a lag is given twice, below 0 or not
        a whole number, a value is not finite, or an error is not above 0.

    Notes
    -----
    Such tables are C_ij over C_00 and the level, or the slope of that against the level, over
    the range of flux that their publisher chose.  Where all lags, counted with both signs, add
    up to less than a hundredth of the sum's error, a_00 was computed from the others and is not a
    measurement.

    Examples
    --------
    >>> import tempfile
    >>> text = "i_serial,j_parallel,cov_per_e,err_per_e\n0,0,-2e-6,1e-8\n0,1,3e-7,1e-8\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "areas.csv"
    ...     _ = path.write_text(text)
    ...     table = read_area_changes(path)
    >>> table.a.shape, float(table.a[1, 0])
    ((2, 1), 3e-07)
    """
    path = Path(path)
    table = read_text(path)
    require(str(path), table.colnames, columns)
    i, j = (whole_numbers(path, table, name, most=LARGEST_LAG) for name in columns[:2])
    a = np.full((j.max() + 1, i.max() + 1), np.nan)
    errors = a.copy()
    if len(set(zip(i.tolist(), j.tolist(), strict=True))) < len(i):
        raise RecordingError(
            f"{path}: a lag ({columns[0]}, {columns[1]}) is given twice; one row each is allowed"
        )
    a[j, i] = numbers(path, table, columns[2], advice=_ADVICE)
    errors[j, i] = numbers(path, table, columns[3], above=0.0, advice=_ADVICE)
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
            "the sum of the others, is not fitted, and the table does not test charge conservation"
        )
    return AreaChangeTable(path, a, errors, independent, tuple(w for w in warnings if w))
