"""Focal planes: table, back bias and temperature of each detector of a camera, from a file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bfsensor.device.shipped import did_you_mean
from bfsensor.errors import SensorError
from bfsensor.sensor.options import find_table, load_table, read_device
from bfsensor.typing import FloatArray

CAMERAS: Mapping[str, str] = {
    "LsstCam": "lsstcam",
    "LsstCamSim": "lsstcam",
    "LsstComCam": "comcam",
    "LsstComCamSim": "comcam",
}
"""Built-in focal planes by the name of the camera in LSST's software."""

OPTIONS: Mapping[str, type] = {
    "temperature": float,
    "full_well": float,
    "strength": float,
    "diffusion_factor": float,
    "shift_map": str,
}
"""Columns that are options of a sensor of the same name."""

_UNITS = {"back_bias": "V", "temperature": "K", "full_well": "electron"}
"""Units of columns; those of a file without units, and those to which a file's are converted."""

_TEXTS = ("detector", "vendor", "serial", "table")

_SAME_BIAS = 0.051
"""Largest difference [V] between the back bias of a row and that of its table.  Derived: a bias that was
rounded to 0.1 V is off by half of that; twice as large would accept another setting by 0.1 V."""


@dataclass(frozen=True)
class FocalPlane:
    """Sensors of a camera's detectors, as a file lists them.

    The file is an .ecsv or .csv table with a row for each detector.  ``detector`` and ``table``
    are required columns, the others optional; an empty cell means that the value is not known.

    ===================  ============================================================
    column               meaning
    ===================  ============================================================
    ``detector``         name of the detector, such as R22_S11
    ``table``            built-in table, or a .fits file (relative: to this file)
    ``vendor``           ITL or E2V; chooses the table of a SiliconSensor
    ``back_bias``        back bias [V], refused if the table was solved for another
    ``serial``           serial number, for the reader
    ===================  ============================================================

    ``temperature`` [K], ``full_well`` [e-], ``strength``, ``diffusion_factor`` and ``shift_map`` (a
    file, relative to this one) are options of the sensor of the same name; by default those of the
    device hold.

    Parameters
    ----------
    path : Path
        File that was read.
    rows : mapping
        Known values of each detector, by its name and by column.

    Examples
    --------
    >>> camera = FocalPlane.read("LsstCamSim")
    >>> len(camera.rows), camera.options("R22_S11")["name"]
    (205, 'e2v_ccd250')
    """

    path: Path
    rows: Mapping[str, Mapping[str, Any]]

    @classmethod
    def read(cls, name: str | Path) -> FocalPlane:
        """Read a focal plane.

        Parameters
        ----------
        name : path-like
            Name of a camera in LSST's software (LsstCam, LsstCamSim, LsstComCam, LsstComCamSim),
            or an .ecsv or .csv file.

        Returns
        -------
        FocalPlane

        Raises
        ------
        SensorError
            The file is missing or no table, has an unknown column or unit, or lists a detector
            twice.
        """
        path = _find(str(name))
        table = _read_table(path)
        rows: dict[str, dict[str, Any]] = {}
        for row in table:
            known = {
                column: _convert(path, column, row[column])
                for column in table.colnames
                if not _is_empty(row[column])
            }
            detector = known.pop("detector", None)
            if detector is None or detector in rows:
                what = "a row without detector" if detector is None else f"{detector} twice"
                raise SensorError(f"{path.name} lists {what}")
            rows[detector] = known
        return cls(path, rows)

    def vendor(self, detector: str) -> str:
        """Vendor of a detector, in capitals; empty where the file does not say."""
        return str(self._row(detector).get("vendor", "")).upper()

    def options(self, detector: str) -> dict[str, Any]:
        """Options of the sensor of a detector.

        Parameters
        ----------
        detector : str
            Name of the detector.

        Returns
        -------
        options : dict
            ``name`` of the table, and those columns of :data:`OPTIONS` that are known.

        Raises
        ------
        SensorError
            The file does not list the detector, or names no table for it; or the table was solved
            for another back bias.
        """
        row = self._row(detector)
        if "table" not in row:
            raise SensorError(
                f"{self.path.name} names no table for {detector}: write one into its column "
                "'table' in a file of your own and give that as focal_plane, or give name"
            )
        table = self._file(row["table"]) if _is_fits(row["table"]) else row["table"]
        if "back_bias" in row:
            self._check_bias(detector, row["table"], table, row["back_bias"])
        options = {column: row[column] for column in OPTIONS if column in row}
        if "shift_map" in options:
            options["shift_map"] = self._file(options["shift_map"])
        return {"name": table, **options}

    def _row(self, detector: str) -> Mapping[str, Any]:
        """Return the known values of a detector; refuse one that is not listed."""
        if detector not in self.rows:
            raise SensorError(
                f"{self.path.name} does not list the detector {detector!r}"
                f"{did_you_mean(detector, self.rows)}"
            )
        return self.rows[detector]

    def _file(self, name: str) -> str:
        """Path of a file that is named relative to this one."""
        return str(self.path.parent / name)

    def _check_bias(self, detector: str, given: str, table: str, bias: float) -> None:
        """Refuse a row whose table was solved for another back bias."""
        device = read_device(load_table(*find_table(table)), given)
        solved = float(device.operating_point.back_bias)
        if abs(solved - bias) > _SAME_BIAS:
            raise SensorError(
                f"{self.path.name}: {detector}: back_bias = {bias:g} V, but the table {given} was "
                f"solved for {solved:g} V; `bfsensor devices` lists the built-in ones with their "
                "voltages, `bfsensor table` solves others"
            )


def _find(name: str) -> Path:
    """Path of a built-in focal plane or of a file."""
    if name in CAMERAS:
        return Path(__file__).parent / "focal_planes" / f"{CAMERAS[name]}.ecsv"
    path = Path(name)
    if path.suffix not in (".ecsv", ".csv") or not os.path.isfile(path):
        raise SensorError(
            f"focal_plane = {name!r} is neither a camera ({', '.join(CAMERAS)}) nor an .ecsv or "
            f".csv file{did_you_mean(name, CAMERAS)}"
        )
    return path.resolve()


def _read_table(path: Path) -> Any:
    """Read the table of a file, with values in our units; refuse unknown columns."""
    from astropy.table import Table

    try:
        table = Table.read(
            path, format="ascii.ecsv" if path.suffix == ".ecsv" else "ascii.csv"
        )
    except (ValueError, OSError) as error:
        raise SensorError(f"{path.name} is no table: {error}") from None
    allowed = (*_TEXTS, "back_bias", *OPTIONS)
    for column in table.colnames:
        if column not in allowed:
            raise SensorError(
                f"{path.name}: the column {column!r} is none of {', '.join(allowed)}"
                f"{did_you_mean(column, allowed)}"
            )
        if table[column].unit is not None and column in _UNITS:
            table[column] = _in_unit(path, table[column], _UNITS[column])
    for column in ("detector", "table"):
        if column not in table.colnames:
            raise SensorError(f"{path.name} has no column {column!r}")
    return table


def _in_unit(path: Path, column: Any, unit: str) -> Any:
    """Values of a column in another unit, nan where there is none."""
    from astropy import units as u

    values: FloatArray = np.ma.filled(np.ma.asarray(column, float), np.nan)
    try:
        return u.Quantity(values, column.unit).to_value(unit, u.temperature())
    except u.UnitConversionError:
        raise SensorError(
            f"{path.name}: {column.name} is in {column.unit}, which is not {unit}"
        ) from None


def _convert(path: Path, column: str, value: Any) -> Any:
    """Return a value of a column as text or number; refuse what is no number where one is due."""
    if column in _TEXTS or OPTIONS.get(column) is str:
        return str(value).strip()
    try:
        return float(value)
    except ValueError:
        raise SensorError(f"{path.name}: {column} = {str(value)!r} is no number") from None


def _is_empty(value: Any) -> bool:
    """Whether a cell holds nothing: masked, empty text, or nan."""
    if np.ma.is_masked(value) or str(value).strip() == "":
        return True
    return isinstance(value, float) and math.isnan(value)


def _is_fits(name: str) -> bool:
    """Whether the name of a table is that of a file."""
    return name.endswith((".fits", ".fits.gz"))
