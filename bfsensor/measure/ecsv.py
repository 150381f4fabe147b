"""ECSV in and out for the results of this room: units kept, equal after reading."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Column, Table

from bfsensor.errors import MeasurementError


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
    kind: str,
    columns: Mapping[str, tuple[Any, str | None, str]],
    meta: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Write columns (values, unit, description) beside and rename them."""
    target = Path(path)
    if target.exists() and not overwrite:
        raise MeasurementError(f"{target} exists; say overwrite to replace it")
    table = Table(
        [
            Column(np.asarray(values), name=name, unit=unit, description=text)
            for name, (values, unit, text) in columns.items()
        ]
    )
    table.meta = {"kind": kind}
    for name, value in meta.items():
        # YAML knows lists and plain numbers only.
        table.meta[name] = np.asarray(value).tolist()
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        table.write(part, format="ascii.ecsv", overwrite=True)
        os.replace(part, target)
    except OSError as error:
        raise MeasurementError(f"{target}: cannot be written: {error}") from None
    finally:
        part.unlink(missing_ok=True)


def read_ecsv(
    path: str | os.PathLike[str], kind: str, columns: Sequence[str], meta: Sequence[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read columns and meta by name; raises MeasurementError naming file and lack."""
    try:
        table = Table.read(path, format="ascii.ecsv")
    except (OSError, ValueError) as error:
        raise MeasurementError(f"{path}: cannot be read: {error}") from None
    if table.meta.get("kind") != kind:
        raise MeasurementError(f"{path}: holds {table.meta.get('kind')!r}, not {kind!r}")
    for name, there in ((columns, table.colnames), (meta, table.meta)):
        lacking = [one for one in name if one not in there]
        if lacking:
            raise MeasurementError(f"{path}: {', '.join(lacking)} missing")
    return {name: np.asarray(table[name]) for name in columns}, {
        name: table.meta[name] for name in meta
    }
