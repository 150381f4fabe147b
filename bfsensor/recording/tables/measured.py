"""What a device is fitted to, read from a file of any known kind, with its condition."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.written_units import to_internal
from bfsensor.errors import DeviceError, RecordingError
from bfsensor.recording.raw.headers import is_fits
from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
from bfsensor.recording.tables.lsst_datasets import PhotonTransferDataset
from bfsensor.recording.tables.setting_tables import (
    SettingTable,
    is_setting_table,
    read_setting_table,
    read_text,
)

CONDITIONS = {
    "back_bias": ("potential", 1.0),
    "gate_high": ("potential", 1.0),
    "gate_low": ("potential", 1.0),
    "temperature": ("temperature", 1.0),
    "wavelength": ("length", 1e3),
}
"""Fields of a condition, with the kind of their quantity and the factor to V, K and nm."""

FEWEST = 3
"""Amplifiers whose scatter gives an error."""


@dataclass(frozen=True, eq=False)
class MeasuredTable:
    """Measured numbers and the condition that holds for all of them.

    Attributes
    ----------
    table : AreaChangeTable or SettingTable
        The numbers.
    condition : Condition
        Of the whole file; None where nothing says.
    sigma : float or None
        Width of the spots of slopes in x and y, diffusion included [pixel]; None: not said.
    """

    table: AreaChangeTable | SettingTable
    condition: Condition = field(default_factory=Condition)
    sigma: float | None = None

    def at(self, given: Mapping[str, str]) -> MeasuredTable:
        """Give a copy with parts of the condition stated anew, as :func:`parse_condition`."""
        fields, sigma = parse_condition(given)
        return replace(
            self,
            condition=replace(self.condition, **fields),
            sigma=self.sigma if sigma is None else sigma,
        )


def parse_condition(given: Mapping[str, Any]) -> tuple[dict[str, Any], float | None]:
    """Turn texts such as ``{'back_bias': '-60 V'}`` into fields of a condition.

    Parameters
    ----------
    given : mapping of str to str
        Quantities with units by the keys of :data:`CONDITIONS`; ``sigma``, a width in pixels,
        without.

    Raises
    ------
    RecordingError
        An unknown key, or not such a quantity.

    Examples
    --------
    >>> parse_condition({"back_bias": "-60 V", "wavelength": "620 nm", "sigma": "1.02"})
    ({'back_bias': -60.0, 'wavelength': 620.0}, 1.02)
    """
    fields: dict[str, Any] = {}
    sigma = None
    for key, value in given.items():
        text = str(value)
        try:
            if key == "sigma":
                sigma = float(text.removesuffix("pix").strip())
                if not 0.1 < sigma < 10:
                    raise RecordingError(f"sigma = {text!r} must be from 0.1 to 10 pixels")
                continue
            kind, factor = CONDITIONS[key]
            fields[key] = round(to_internal(text, kind) * factor, 9)
        except KeyError:
            raise RecordingError(
                f"{key!r} is no condition; there are {', '.join(CONDITIONS)} and sigma"
            ) from None
        except DeviceError as error:
            raise RecordingError(f"{key}: {error}") from None
        except RecordingError:
            raise
        except ValueError:
            raise RecordingError(f"{key} = {text!r} is not a number") from None
    return fields, sigma


def read_measured(path: str | os.PathLike[str]) -> MeasuredTable:
    """Read measured a_ij, slopes, saturation levels or diffusion widths.

    Parameters
    ----------
    path : path-like
        a_ij (:func:`~bfsensor.recording.tables.area_changes.read_area_changes`), LSST's photon transfer
        dataset, or a table by setting
        (:func:`~bfsensor.recording.tables.setting_tables.read_setting_table`).  The header of an ECSV
        file may have an entry ``conditions`` with the keys of :func:`parse_condition`.

    Returns
    -------
    MeasuredTable

    Raises
    ------
    RecordingError
        None of these kinds, or wrong in itself.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    if is_fits(path.name):
        return MeasuredTable(area_changes_of_amplifiers(path))
    table = read_text(path)
    if str(table.meta.get("OBSTYPE", "")).strip() == "PTC":
        return MeasuredTable(area_changes_of_amplifiers(path))
    stated = table.meta.get("conditions", {})
    if not isinstance(stated, Mapping):
        raise RecordingError(f"{path}: conditions = {stated!r} must be a mapping")
    if {"i_serial", "j_parallel", "cov_per_e", "err_per_e"} <= set(table.colnames):
        found = MeasuredTable(read_area_changes(path))
    elif is_setting_table(table.colnames) is not None:
        found = MeasuredTable(read_setting_table(path))
    elif {"i", "j", "cov"} <= set(table.colnames):
        raise RecordingError(
            f"{path}: covariances by level; fit their a_ij first (fit_covariances) and give "
            "columns i_serial, j_parallel, cov_per_e, err_per_e"
        )
    else:
        raise RecordingError(
            f"{path}: neither a_ij (i_serial, j_parallel, cov_per_e, err_per_e) nor slopes, "
            f"saturation or diffusion by setting; its columns are {', '.join(table.colnames)}"
        )
    try:
        return found.at(stated)
    except RecordingError as error:
        raise RecordingError(f"{path}: conditions: {error}") from None


def area_changes_of_amplifiers(path: Path) -> AreaChangeTable:
    """Mean a_ij of the amplifiers of LSST's photon transfer dataset, with the mean's error.

    Raises
    ------
    RecordingError
        Fewer than :data:`FEWEST` amplifiers with a finite matrix: no scatter, no error.
    """
    a = np.asarray(PhotonTransferDataset.read(path).columns["A_MATRIX"], float)
    a = a[np.isfinite(a).all(axis=(1, 2))]
    if len(a) < FEWEST:
        raise RecordingError(
            f"{path}: {len(a)} amplifiers with an A_MATRIX; the error of the mean is taken from "
            f"their scatter, which needs {FEWEST}"
        )
    errors = a.std(axis=0, ddof=1) / np.sqrt(len(a))
    if not np.all(errors > 0):
        raise RecordingError(f"{path}: the amplifiers' A_MATRIX do not differ: no errors")
    return AreaChangeTable(path, a.mean(axis=0), errors, np.isfinite(errors))
