"""Writing and reading of measurements as ECSV, with units, equal bit for bit after reading."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from astropy.table import Column, Table
from numpy.typing import NDArray

from bfsensor.errors import MeasurementError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.text_files import UnreadableTextError
from bfsensor.text_files import read_ecsv as read_any


def same_fields(one: Any, other: Any) -> bool:
    """Whether two results of one class have equal fields, bit for bit, nan equal to nan."""
    if type(one) is not type(other):
        return False
    for item in fields(one):
        a, b = getattr(one, item.name), getattr(other, item.name)
        floats = np.issubdtype(np.asarray(a).dtype, np.floating)
        if not np.array_equal(np.asarray(a), np.asarray(b), equal_nan=floats):
            return False
    return True


def write_ecsv(
    path: str | os.PathLike[str],
    schema: str,
    columns: Mapping[str, tuple[Any, str | None, str]],
    meta: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Write columns with units and descriptions, and single values in the header.

    Parameters
    ----------
    path : path-like
        File to write, under another name first and then renamed.
    schema : str
        Name of the kind of file, for :func:`read_ecsv`.
    columns : mapping of str to (array_like, str or None, str)
        Values with rows along the first axis, unit and description of each column.
    meta : mapping
        Single values and short arrays for the header.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    MeasurementError
        The file exists and ``overwrite`` is False, or it cannot be written.
    """
    refuse_existing(path, overwrite, MeasurementError)
    table = Table(
        [
            Column(np.asarray(values), name=name, unit=unit, description=text or None)
            for name, (values, unit, text) in columns.items()
        ]
    )
    table.meta = {"schema": schema}
    for name, value in meta.items():
        # ECSV headers are YAML, which has lists and plain numbers but no arrays.
        table.meta[name] = np.asarray(value).tolist()
    with written_whole(path, MeasurementError) as beside:
        table.write(beside, format="ascii.ecsv", overwrite=True)


def read_ecsv(
    path: str | os.PathLike[str], schema: str, columns: Sequence[str], meta: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read columns and single values by name.

    Parameters
    ----------
    path : path-like
        The file.
    schema : str
        Name of the kind of file that it must have.
    columns, meta : sequence of str
        Columns and header entries that it must have; others are ignored.

    Returns
    -------
    columns, meta : dict
        Arrays of the columns, and values of the header.

    Raises
    ------
    MeasurementError
        The file is missing, damaged or of another schema, or lacks a column or an entry, which
        the message names.
    """
    try:
        table = read_any(path)
    except UnreadableTextError as error:
        raise MeasurementError(f"{path}: not readable as ECSV: {error}") from None
    # Older files of curves and fits have the schema under 'kind'.
    found = table.meta.get("schema", table.meta.get("kind"))
    if found != schema:
        raise MeasurementError(
            f"{path}: its schema is {found!r}, not {schema!r}: it is a file of another kind"
        )
    for names, there in ((columns, table.colnames), (meta, table.meta)):
        lacking = [name for name in names if name not in there]
        if lacking:
            raise MeasurementError(f"{path}: {', '.join(lacking)} missing")
    found_columns = {}
    for name in columns:
        values = np.asarray(table[name])
        empty = getattr(table[name], "mask", np.False_)
        if np.any(empty) and values.dtype.kind != "U":
            raise MeasurementError(f"{path}: column {name} has empty cells")
        found_columns[name] = np.where(empty, "", values) if np.any(empty) else values
    return found_columns, {name: table.meta[name] for name in meta}


def square_lags(
    path: str | os.PathLike[str], columns: Mapping[str, NDArray[Any]]
) -> dict[str, Any]:
    """Turn columns with a row for each lag into arrays (lags + 1, lags + 1, ...), [j, i].

    Parameters
    ----------
    path : path-like
        Name of the file, for errors.
    columns : mapping of str to ndarray
        Columns, among them the lags ``i`` and ``j``; rows may be in any order.

    Returns
    -------
    arrays : dict of str to ndarray
        The columns other than ``i`` and ``j``.

    Raises
    ------
    MeasurementError
        The lags do not fill a square from (0, 0).
    """
    side = round(len(columns["i"]) ** 0.5)
    order = np.lexsort((columns["i"], columns["j"]))
    j, i = np.indices((side, side))
    if side * side != len(order) or not (
        np.array_equal(columns["i"][order], i.ravel())
        and np.array_equal(columns["j"][order], j.ravel())
    ):
        raise MeasurementError(
            f"{path}: its {len(order)} lags do not fill a square from (0, 0), one row each"
        )
    return {
        name: values[order].reshape(side, side, *values.shape[1:])
        for name, values in columns.items()
        if name not in ("i", "j")
    }
