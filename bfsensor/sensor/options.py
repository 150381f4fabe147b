"""What a sensor may be given: tables by name, numbers in a range, words of a list."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

from bfsensor.device.device import Device
from bfsensor.device.shipped import did_you_mean, tables_dir
from bfsensor.errors import SensorError, TableError
from bfsensor.table.table import DistortionTable


def find_table(name: str) -> tuple[str, int]:
    """Find a built-in table or a file, and when it was changed."""
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
    """Say where a device file or a table of GalSim's belongs, given as a table of ours."""
    if name.endswith(".toml"):
        raise SensorError(
            f"{name} is a device file, a sensor needs its distortion table: run `bfsensor table "
            f"{name}` and give the .fits file that it writes"
        )
    stem = name.removesuffix(".cfg").removesuffix(".dat")
    if Path(f"{stem}.cfg").is_file() or (galsim_folder() / f"{stem}.cfg").is_file():
        raise SensorError(
            f"{name} is a table of GalSim's: bfsensor.SiliconSensor takes it, "
            "BrighterFatterSensor takes tables made by `bfsensor table`"
        )


def galsim_folder() -> Path:
    """Find the folder of the tables that come with GalSim."""
    import galsim

    return Path(galsim.meta_data.share_dir) / "sensors"


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


def read_device(table: DistortionTable, name: str) -> Device:
    """Give the device in a table; a table without one is refused."""
    if not table.device_text:
        raise SensorError(
            f"the table of {name} holds no device, which gives drift field and temperature"
        )
    return Device.from_toml(table.device_text)


def check_reach(qdist: int | None, table: DistortionTable, name: str) -> int:
    """Give how far charge acts [pixel], by default as far as the table reaches."""
    reach = table.reach if qdist is None else int(qdist)
    if not 0 <= reach <= table.reach:
        raise SensorError(
            f"qdist = {qdist} must be from 0 to {table.reach}: the table of {name} holds "
            "charge no further away"
        )
    return reach


def check_full_well(full_well: float | None, table: DistortionTable) -> float:
    """Give the full well [e-], by default the table's; inf where there is none."""
    well = table.full_well if full_well is None else float(full_well)
    if not (math.isnan(well) or well > 0):
        raise SensorError(f"full_well = {full_well} must be above 0 e- (inf: none)")
    return math.inf if math.isnan(well) else well


def check_threads(threads: int) -> int:
    """Give a number of threads."""
    if int(threads) < 1:
        raise SensorError(f"threads = {threads} must be at least 1")
    return int(threads)


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
