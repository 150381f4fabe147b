"""What a sensor may be given: tables by name, numbers in a range, words of a list."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

from bfsensor.errors import SensorError, TableError
from bfsensor.files import tables_dir
from bfsensor.table.table import DistortionTable


def find_table(name: str) -> tuple[str, int]:
    """Find a built-in table or a file, and when it was changed."""
    folder = tables_dir()
    if str(name).endswith((".fits", ".fits.gz")) or Path(name).is_file():
        path = Path(name)
    else:
        path = folder / str(name) / "table.fits"
        if not path.is_file():
            known = sorted(p.parent.name for p in folder.glob("*/table.fits"))
            raise SensorError(
                f"name = {str(name)!r} is neither a built-in table ({', '.join(known)}) nor "
                "a .fits file"
            )
    return str(path.resolve()), path.stat().st_mtime_ns if path.exists() else 0


def load_table(path: str, changed: int) -> DistortionTable:
    """Read a table; another than when the sensor was made is refused."""
    try:
        table = _read(path, changed)
    except TableError as error:
        raise SensorError(str(error)) from None
    return table


def check_table(table: DistortionTable | None) -> DistortionTable:
    """Give a table in memory back; anything else is refused."""
    if not isinstance(table, DistortionTable):
        raise SensorError(f"table must be a DistortionTable, not {type(table).__name__}")
    return table


@lru_cache(maxsize=8)
def _read(path: str, changed: int) -> DistortionTable:
    """Read a table once for all sensors of a process."""
    return DistortionTable.read(path)


def check_number(
    name: str, value: float, *, low: float = -math.inf, high: float = math.inf
) -> float:
    """Give a finite number in a range; anything else is refused."""
    number = float(value)
    if not (math.isfinite(number) and low <= number <= high):
        allowed = f" from {low:g}" if math.isfinite(low) else ""
        allowed += f" to {high:g}" if math.isfinite(high) else ""
        raise SensorError(f"{name} = {value} must be a finite number{allowed}")
    return number


def check_word(name: str, value: str, allowed: tuple[str, ...]) -> str:
    """Give one of some words; anything else is refused."""
    if value not in allowed:
        raise SensorError(f"{name} = {value!r} must be one of {', '.join(allowed)}")
    return value
