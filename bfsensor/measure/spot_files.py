"""Results of measurements as ECSV: written whole or not at all, read only if known."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from astropy.io.ascii import InconsistentTableError
from astropy.table import Table

from bfsensor.errors import MeasurementError


def write_ecsv(
    path: str | os.PathLike[str], table: Table, schema: str, meta: Mapping[str, Any]
) -> None:
    """Write a table with its schema and single values in the header, beside and renamed."""
    path = Path(path)
    table.meta = {"schema": schema, **meta}
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        table.write(beside, format="ascii.ecsv", overwrite=True)
        os.replace(beside, path)
    except OSError as error:
        raise MeasurementError(f"{path}: cannot be written: {error}") from None
    finally:
        beside.unlink(missing_ok=True)


def read_ecsv(
    path: str | os.PathLike[str], schema: str, needed: Mapping[str, tuple[str, ...]]
) -> Table:
    """Read a table of a schema, with the columns and header entries that it needs."""
    path = Path(path)
    try:
        table = Table.read(path, format="ascii.ecsv")
    except (OSError, ValueError, InconsistentTableError) as error:
        line = " ".join(str(error).split())[:200]
        raise MeasurementError(f"{path}: not readable as ECSV: {line}") from None
    found = table.meta.get("schema", "none")
    if found != schema:
        raise MeasurementError(f"{path}: its schema is {found!r}, not {schema!r}")
    missing = [name for name in needed["columns"] if name not in table.colnames]
    missing += [name for name in needed["header"] if name not in table.meta]
    if missing:
        raise MeasurementError(f"{path}: {', '.join(missing)} missing")
    return table
