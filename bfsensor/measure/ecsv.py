"""ECSV in and out for the results of this room: units kept, equal after reading."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from astropy.table import Column, Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from bfsensor.errors import MeasurementError
from bfsensor.files import refuse_existing, written_whole


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
    """Write columns (values, unit, description) and single values of the header.

    Parameters
    ----------
    path : path-like
        The file, written whole or not at all.
    schema : str
        What the file is.
    columns : mapping of str to (array_like, str or None, str)
        Rows along the first axis.
    meta : mapping
        Single values and short arrays.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    MeasurementError
        The file exists and ``overwrite`` is not set, or it cannot be written.
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
        # YAML knows lists and plain numbers only.
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
        What it must be.
    columns, meta : sequence of str
        What it must hold; anything else in it is left alone.

    Returns
    -------
    columns, meta : dict
        Arrays, and values of the header.

    Raises
    ------
    MeasurementError
        The file is missing, damaged, of another schema, or lacks something; names it.
    """
    try:
        with warnings.catch_warnings():
            # Of types that are none astropy only warns.
            warnings.simplefilter("error", AstropyUserWarning)
            table = Table.read(path, format="ascii.ecsv")
    # Damaged headers end in several kinds of exception inside astropy.
    except (
        OSError, ValueError, TypeError, KeyError, AttributeError, AstropyUserWarning
    ) as error:  # fmt: skip
        line = " ".join(str(error).split())[:200]
        raise MeasurementError(f"{path}: not readable as ECSV: {line}") from None
    # Curves and fits of flats said 'kind' once.
    found = table.meta.get("schema", table.meta.get("kind"))
    if found != schema:
        raise MeasurementError(f"{path}: its schema is {found!r}, not {schema!r}")
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
    """Bring columns with a row for each lag to the shape (lags + 1, lags + 1, ...), [j, i].

    Parameters
    ----------
    path : path-like
        The file, for the error.
    columns : mapping of str to ndarray
        With the lags as ``i`` and ``j``; rows in any order.

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
        raise MeasurementError(f"{path}: its lags do not fill a square from (0, 0)")
    return {
        name: values[order].reshape(side, side, *values.shape[1:])
        for name, values in columns.items()
        if name not in ("i", "j")
    }
