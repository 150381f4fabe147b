"""Checks of the arguments of sensors: tables by name, numbers in a range, words of a list."""

from __future__ import annotations

import math
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.device.device import Device
from bfsensor.device.shipped import did_you_mean, tables_dir
from bfsensor.errors import SensorError, SensorTypeError, TableError
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

HIGHEST_CHARGE = 1e9
"""Highest level of a flat and of the charge beyond an image [e-].

Chosen: a thousand full wells; single precision holds whole
electrons up to 1.7e7, and at twice as much nothing changes."""

LARGEST = 1e6
"""Largest strength and factor on the diffusion.

Chosen: ten thousand times the largest strength in use (100); at 1e30 sums of shifts overflow, at
twice as large nothing changes."""


def find_table(name: str) -> tuple[str, int]:
    """Find a built-in table or a .fits file.

    Parameters
    ----------
    name : str
        Name of a built-in device, or a path.

    Returns
    -------
    path : str
        Absolute path of the table.
    changed : int
        Time of its last change [ns], 0 where the file does not exist.

    Raises
    ------
    SensorError
        Neither; the message lists the built-in tables, or says what to do with a file of another
        kind.
    """
    folder = tables_dir()
    path = Path(name)
    others = path.suffix in (".toml", ".cfg", ".dat")
    # os.path.isfile is False for names that no file can have, where Path.is_file may raise.
    if not str(name).endswith((".fits", ".fits.gz")) and (
        others or not os.path.isfile(path)
    ):
        path = folder / str(name) / "table.fits"
        if not os.path.isfile(path):
            _refuse_other_files(str(name))
            known = sorted(p.parent.name for p in folder.glob("*/table.fits"))
            raise SensorError(
                f"name = {shown(str(name))} is neither a built-in table ({', '.join(known)}) nor "
                f"a .fits file{did_you_mean(str(name), known)}"
            )
    if not os.path.exists(path):
        return str(path), 0
    return str(path.resolve()), path.stat().st_mtime_ns


def _refuse_other_files(name: str) -> None:
    """Refuse device files and GalSim's tables, with the call that takes them."""
    if name.endswith(".toml"):
        raise SensorError(
            f"{name} is a device file, and a sensor needs a distortion table: run `bfsensor table "
            f"{name}` and give the .fits file that it writes"
        )
    stem = name.removesuffix(".cfg").removesuffix(".dat")
    if any(os.path.isfile(f"{start}.cfg") for start in (stem, galsim_folder() / stem)):
        raise SensorError(
            f"{name} is a table in GalSim's format: give it to bfsensor.SiliconSensor; "
            "BrighterFatterSensor takes tables made by `bfsensor table`"
        )


def galsim_folder() -> Path:
    """Return the folder of the tables that come with GalSim."""
    import galsim

    return Path(galsim.meta_data.share_dir) / "sensors"


def load_table(path: str, changed: int) -> DistortionTable:
    """Read a table, once for all sensors of a process while the file stays unchanged.

    Parameters
    ----------
    path : str
        Absolute path of the table.
    changed : int
        Time of the file's last change [ns], from :func:`find_table`.

    Returns
    -------
    DistortionTable

    Raises
    ------
    SensorError
        The file cannot be read as a table.
    """
    try:
        table = _read(path, changed)
    except TableError as error:
        raise SensorError(str(error)) from None
    return table


def check_table(table: DistortionTable | None) -> DistortionTable:
    """Return a table in memory; refuse anything else."""
    if not isinstance(table, DistortionTable):
        raise SensorTypeError(
            f"table must be a DistortionTable, not {type(table).__name__}"
        )
    return table


@lru_cache(maxsize=8)
def _read(path: str, changed: int) -> DistortionTable:
    """Read a table; ``changed`` is part of the cache's key, so that a changed file is read again."""
    return DistortionTable.read(path)


def read_device(table: DistortionTable, name: str) -> Device:
    """Return the device in a table; refuse a table without one."""
    if not table.device_text:
        raise SensorError(
            f"the table of {name} holds no device, from which drift field and temperature are taken"
        )
    return Device.from_toml(table.device_text)


def check_reach(qdist: int | None, table: DistortionTable, name: str) -> int:
    """Return the distance at which charge acts [pixel], by default the table's reach."""
    if qdist is None:
        return table.reach
    number = to_float(truth_as_number(qdist))
    if not (number.is_integer() and 0 <= number <= table.reach):
        raise wrong_value(
            qdist,
            f"qdist = {shown(qdist)} must be from 0 to {table.reach}, the reach of the table of "
            f"{name}",
        )
    return int(number)


def check_full_well(full_well: float | None, table: DistortionTable) -> float:
    """Return the full well [e-], by default the table's; inf where there is none."""
    if full_well is None:
        return math.inf if math.isnan(table.full_well) else table.full_well
    well = to_float(full_well)
    if not well > 0:
        raise wrong_value(
            full_well, f"full_well = {shown(full_well)} must be above 0 e- (inf: none)"
        )
    return well


def check_threads(threads: int | None) -> int | None:
    """Return a number of threads, or None for GalSim's; refuse less than 1."""
    if threads is None:
        return None
    number = to_float(threads)
    if not (number.is_integer() and number >= 1):
        raise wrong_value(
            threads,
            f"threads = {shown(threads)} must be at least 1, a whole number, or None: as many as "
            "galsim.get_omp_threads() says",
        )
    return int(number)


def check_number(
    name: str,
    value: float,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    infinite: bool = False,
) -> float:
    """Return a number within a range, finite unless ``infinite``; refuse anything else."""
    number = to_float(value)
    if not (low <= number <= high and (infinite or math.isfinite(number))):
        kind = "number" if infinite else "finite number"
        raise wrong_value(
            value, f"{name} = {shown(value)} must be a {kind}{_range(low, high)}"
        )
    return number


def check_whole(
    name: str, value: int, *, low: float = -math.inf, high: float = math.inf
) -> int:
    """Return a whole number within a range; refuse anything else."""
    number = to_float(value)
    if not (number.is_integer() and low <= number <= high):
        raise wrong_value(
            value, f"{name} = {shown(value)} must be a whole number{_range(low, high)}"
        )
    return int(number)


def check_shape(name: str, value: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns, whole numbers of at least 1; refuse anything else."""
    try:
        rows, columns = (to_float(n) for n in value)
    except (TypeError, ValueError):
        rows = columns = math.nan
    if not all(n.is_integer() and 1 <= n <= 1e6 for n in (rows, columns)):
        raise wrong_value(
            value,
            f"{name} = {shown(value)} must be rows and columns, at least (1, 1) and at most a "
            "million each",
        )
    return int(rows), int(columns)


def check_flag(name: str, value: bool) -> bool:
    """Return True or False; refuse anything but these, 1 and 0."""
    number = math.nan if isinstance(value, str) else to_float(truth_as_number(value))
    if number not in (0.0, 1.0):
        raise wrong_value(value, f"{name} = {shown(value)} must be True or False")
    return bool(number)


def check_diffusion(value: str | float) -> str | float:
    """Return 'device', 'einstein' or a number from 0; a text of a number, as in YAML, is one."""
    if isinstance(value, str) and value in ("device", "einstein"):
        return value
    number = to_float(value)
    if not 0.0 <= number <= LARGEST:
        raise wrong_value(
            value,
            f"diffusion = {shown(value)} must be 'device', 'einstein', or the width over Einstein's, a "
            f"number from 0 to {LARGEST:g}",
        )
    return number


def check_surroundings(value: str | float) -> str | float:
    """Return 'none', 'mirrored' or a charge from 0; a text of a number, as in YAML, is one."""
    if isinstance(value, str) and value in ("none", "mirrored"):
        return value
    number = to_float(value)
    if not 0.0 <= number <= HIGHEST_CHARGE:
        raise wrong_value(
            value,
            f"surroundings = {shown(value)} must be 'none', 'mirrored', or the charge of every pixel "
            f"beyond the image, a number from 0 to {HIGHEST_CHARGE:g} e-",
        )
    return number


def outside_charge(surroundings: str | float) -> float:
    """Charge beyond the image [e-] as kernels take it; nan: mirrored."""
    if surroundings == "mirrored":
        return math.nan
    return 0.0 if surroundings == "none" else float(surroundings)


def check_word(name: str, value: str, allowed: tuple[str, ...]) -> str:
    """Return a word of a list; refuse anything else."""
    if not isinstance(value, str) or value not in allowed:
        raise wrong_value(
            value, f"{name} = {shown(value)} must be one of {', '.join(allowed)}"
        )
    return value


def check_path(name: str, value: str | os.PathLike[str], what: str) -> str:
    """Return a path as text; refuse anything but text and path-like objects."""
    if not isinstance(value, str | os.PathLike):
        raise SensorTypeError(f"{name} = {shown(value)} must be {what}")
    return str(value)


def check_array(name: str, value: ArrayLike) -> FloatArray:
    """Return a new array of float64; refuse what is no real numbers."""
    try:
        if not np.iscomplexobj(value):
            return np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise wrong_value(value, f"{name} = {shown(value)} must be an array of real numbers")


def check_instance(name: str, value: Any, kind: type, what: str) -> None:
    """Refuse what is no object of a class."""
    if not isinstance(value, kind):
        raise SensorTypeError(f"{name} = {shown(value)} must be {what}")


def wrong_value(value: Any, text: str) -> SensorError:
    """Return the error for a number or text that is not allowed, or for a value of another type."""
    if isinstance(value, str | int | float | np.number):
        return SensorError(text)
    return SensorTypeError(text)


def truth_as_number(value: Any) -> Any:
    """Return 1 and 0 for True and False, which GalSim takes for numbers; anything else as it is."""
    return int(value) if isinstance(value, bool | np.bool_) else value


def to_float(value: Any) -> float:
    """Convert a number or its text, as GalSim does; nan stands for anything else, also for True."""
    try:
        if isinstance(value, bool | np.bool_) or np.ndim(value) or np.iscomplexobj(value):
            return math.nan
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def shown(value: Any) -> str:
    """Return a value as messages show it: in one line of at most 60 characters."""
    kind = type(value)
    if isinstance(value, int) and abs(value) > 10**300:
        text = "a huge number"  # beyond 4300 digits Python would refuse to write it
    elif isinstance(value, np.generic):
        text = f"{value}"
    elif kind.__repr__ is object.__repr__:
        text = f"an object of the class {kind.__qualname__}"
    else:
        text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:56]} ..."


def _range(low: float, high: float) -> str:
    """Words for the ends of a range that are finite."""
    out = f" from {low:g}" if math.isfinite(low) else ""
    return out + (f" to {high:g}" if math.isfinite(high) else "")
