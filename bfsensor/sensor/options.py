"""Checks of a sensor's options: tables by name, numbers in a range, words of a list."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

from bfsensor.device.device import Device
from bfsensor.device.shipped import did_you_mean, tables_dir
from bfsensor.errors import SensorError, TableError
from bfsensor.table.table import DistortionTable


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
    if not str(name).endswith((".fits", ".fits.gz")) and (others or not path.is_file()):
        path = folder / str(name) / "table.fits"
        if not path.is_file():
            _refuse_other_files(str(name))
            known = sorted(p.parent.name for p in folder.glob("*/table.fits"))
            raise SensorError(
                f"name = {str(name)!r} is neither a built-in table ({', '.join(known)}) nor "
                f"a .fits file{did_you_mean(str(name), known)}"
            )
    return str(path.resolve()), path.stat().st_mtime_ns if path.exists() else 0


def _refuse_other_files(name: str) -> None:
    """Refuse device files and GalSim's tables, with the call that takes them."""
    if name.endswith(".toml"):
        raise SensorError(
            f"{name} is a device file, and a sensor needs a distortion table: run `bfsensor table "
            f"{name}` and give the .fits file that it writes"
        )
    stem = name.removesuffix(".cfg").removesuffix(".dat")
    if Path(f"{stem}.cfg").is_file() or (galsim_folder() / f"{stem}.cfg").is_file():
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
        raise SensorError(f"table must be a DistortionTable, not {type(table).__name__}")
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
    reach = table.reach if qdist is None else int(qdist)
    if not 0 <= reach <= table.reach:
        raise SensorError(
            f"qdist = {qdist} must be from 0 to {table.reach}, the reach of the table of {name}"
        )
    return reach


def check_full_well(full_well: float | None, table: DistortionTable) -> float:
    """Return the full well [e-], by default the table's; inf where there is none."""
    well = table.full_well if full_well is None else float(full_well)
    if not (math.isnan(well) or well > 0):
        raise SensorError(f"full_well = {full_well} must be above 0 e- (inf: none)")
    return math.inf if math.isnan(well) else well


def check_threads(threads: int) -> int:
    """Return a number of threads; refuse less than 1."""
    if int(threads) < 1:
        raise SensorError(f"threads = {threads} must be at least 1")
    return int(threads)


def check_number(
    name: str, value: float, *, low: float = -math.inf, high: float = math.inf
) -> float:
    """Return a finite number within a range; refuse anything else."""
    number = float(value)
    if not (math.isfinite(number) and low <= number <= high):
        allowed = f" from {low:g}" if math.isfinite(low) else ""
        allowed += f" to {high:g}" if math.isfinite(high) else ""
        raise SensorError(f"{name} = {value} must be a finite number{allowed}")
    return number


def check_diffusion(value: str | float) -> str | float:
    """Return 'device', 'einstein' or a number from 0; a text of a number, as in YAML, is one."""
    if value in ("device", "einstein"):
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise SensorError(
            f"diffusion = {value!r} must be 'device', 'einstein', or the width over Einstein's, a "
            "finite number from 0"
        )
    return number


def check_surroundings(value: str | float) -> str | float:
    """Return 'none', 'mirrored' or a charge from 0; a text of a number, as in YAML, is one."""
    if value in ("none", "mirrored"):
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise SensorError(
            f"surroundings = {value!r} must be 'none', 'mirrored', or the charge of every pixel beyond "
            "the image, a finite number from 0 e-"
        )
    return number


def outside_charge(surroundings: str | float) -> float:
    """Charge beyond the image [e-] as kernels take it; nan: mirrored."""
    if surroundings == "mirrored":
        return math.nan
    return 0.0 if surroundings == "none" else float(surroundings)


def check_word(name: str, value: str, allowed: tuple[str, ...]) -> str:
    """Return a word of a list; refuse anything else."""
    if value not in allowed:
        raise SensorError(f"{name} = {value!r} must be one of {', '.join(allowed)}")
    return value
