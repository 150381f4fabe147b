"""Columns of comma-separated and ECSV tables as numbers within limits; faults name file and row."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from astropy.io import ascii as text_tables
from astropy.io.ascii import InconsistentTableError
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.text_files import nearly_equal, one_line, read_ecsv, read_lines
from bfsensor.typing import FloatArray

LARGEST_LAG = 1000
"""Largest lag of a table [pixel].  Chosen: matrices of lags to 1000 take 8 MB each, and no measurement
has lags beyond 30; twice as large, they take 32 MB, and at 300,000 they took 671 GB."""


def read_text(path: Path) -> Table:
    """Read a comma-separated table, in which lines that begin with # are comments, or ECSV.

    Parameters
    ----------
    path : Path
        The file; ECSV where its name ends in .ecsv.

    Returns
    -------
    table : astropy.table.Table
        Empty cells are masked.

    Raises
    ------
    RecordingError
        The file cannot be read as such a table.
    """
    try:
        if path.suffix == ".ecsv":
            return read_ecsv(path)
        read_lines(path)  # Refuses what is no text.
        return text_tables.read(path, format="csv", comment="#")
    except (OSError, ValueError, InconsistentTableError) as error:
        raise RecordingError(f"{path}: cannot be read: {one_line(error)}") from None


def refuse_misspelt(path: Path, given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse the name of a column or header entry that is that of a missing one but for a letter.

    Columns of other names are left to their owners.

    Parameters
    ----------
    path : Path
        The file, for the message.
    given : iterable of str
        Names in the file.
    known : iterable of str
        Names that are read.

    Raises
    ------
    RecordingError
        A name is misspelt.
    """
    given, known = list(given), list(known)
    lacking = [name for name in known if name not in given]
    for name in given:
        # A unit or a sign after the word, as in 'flux [e-]', is a misspelling too.
        words = {name, re.match(r"\w*", name)[0]}  # type: ignore[index]
        meant = next((o for o in lacking if any(nearly_equal(w, o) for w in words)), None)
        if name not in known and meant is not None:
            raise RecordingError(f"{path}: {name!r} is not known; did you mean {meant!r}?")


def floats(path: Path, table: Table, name: str) -> FloatArray:
    """Column of a table as floats; nan where it is masked or missing.

    Raises
    ------
    RecordingError
        A cell is no number, or the table has no rows; the message names file, row and column.
    """
    if not len(table):
        raise RecordingError(f"{path}: no rows")
    if name not in table.colnames:
        return np.full(len(table), np.nan)
    column = np.ma.asarray(table[name])
    out = np.full(len(table), np.nan)
    for row, (cell, empty) in enumerate(
        zip(np.ma.getdata(column), np.ma.getmaskarray(column), strict=True)
    ):
        if not np.all(empty):
            try:
                out[row] = float(cell)
            except (TypeError, ValueError, OverflowError):
                text = one_line(cell, 60)
                raise RecordingError(
                    f"{path}: row {row + 1}: {name} = {text!r} is not a number"
                ) from None
    return out


def numbers(
    path: Path,
    table: Table,
    name: str,
    *,
    above: float = -np.inf,
    blank: bool = False,
    advice: str = "",
) -> FloatArray:
    """Column of finite numbers above a limit.

    Parameters
    ----------
    path : Path
        The file, for the message.
    table : astropy.table.Table
        The table.
    name : str
        Column; where it is missing all values are nan.
    above : float
        Limit that numbers are above.
    blank : bool
        Whether cells may be empty, or nan.
    advice : str
        End of the message.

    Returns
    -------
    values : ndarray, shape (n,)
        The numbers; nan for empty cells.

    Raises
    ------
    RecordingError
        Another cell; the message names the first one's row, and how many there are.
    """
    values = floats(path, table, name)
    wrong = ~np.isfinite(values) | (values <= above)
    if blank or name not in table.colnames:
        wrong &= ~np.isnan(values)
    if wrong.any():
        row = int(np.argmax(wrong))
        kind = "a finite number" if above == -np.inf else f"a number above {above:g}"
        raise RecordingError(
            f"{path}: row {row + 1}: {name} = {values[row]:g} must be {kind} ({int(wrong.sum())} of "
            f"{len(values)} rows){advice}"
        )
    return values


def whole_numbers(
    path: Path, table: Table, name: str, *, most: float = 2.0**53
) -> NDArray[np.int64]:
    """Column of a table as whole numbers from 0; 0 where it is missing.

    Parameters
    ----------
    path : Path
        The file, for the message.
    table : astropy.table.Table
        The table.
    name : str
        The column.
    most : float
        Largest number; by default that up to which floats hold every whole number.

    Returns
    -------
    values : ndarray of int, shape (n,)
        The numbers.

    Raises
    ------
    RecordingError
        A cell is something else; the message names its row.
    """
    if name not in table.colnames:
        return np.zeros(len(table), np.int64)
    values = floats(path, table, name)
    wrong = ~((values >= 0) & (values <= most) & (values == np.round(values)))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise RecordingError(
            f"{path}: row {row + 1}: {name} = {values[row]:g} must be a whole number from 0 to "
            f"{most:.0f}"
        )
    return values.astype(np.int64)
