"""Measured tables to which a device is fitted, read from files of several kinds."""

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
)
from bfsensor.recording.tables.text_tables import read_text

CONDITIONS = {
    "back_bias": ("potential", 1.0),
    "gate_high": ("potential", 1.0),
    "gate_low": ("potential", 1.0),
    "temperature": ("temperature", 1.0),
    "wavelength": ("length", 1e3),
}
"""Fields of a condition, each with the kind of its quantity and a factor to V, K or nm.

The factor is exact: 1 for internal units (V, K), and 1000 nm to an um for a wavelength.
"""

HIGHEST_LEVEL = 1e9
"""Highest charge in every pixel about which a response was measured [e-].  Chosen: a thousand full
wells, as for sensors; at twice as much nothing changes."""

FEWEST = 3
"""Smallest number of amplifiers from whose scatter the error of their mean is taken.

Chosen: the scatter of n amplifiers has itself a relative error of 1 / sqrt(2 (n - 1)), 50 % for 3.  With
6 it would be 32 %, and datasets of 3 to 5 amplifiers would be refused.
"""


@dataclass(frozen=True, eq=False)
class MeasuredTable:
    """A measured table and the condition that holds for all of it.

    Attributes
    ----------
    table : AreaChangeTable or SettingTable
        The measured numbers with their errors.
    condition : Condition
        Condition of the whole file; its fields are None where the file states nothing.
    sigma : float or None
        Rms width in x and y of the spots whose slopes were measured, diffusion included
        [pixel]; None where the file does not state it.

    Examples
    --------
    :func:`read_measured` makes one; its example shows the condition.
    """

    table: AreaChangeTable | SettingTable
    condition: Condition = field(default_factory=Condition)
    sigma: float | None = None

    def at(self, given: Mapping[str, str]) -> MeasuredTable:
        """Return a copy with parts of the condition replaced.

        Parameters
        ----------
        given : mapping of str to str
            Quantities with units such as ``{'back_bias': '-60 V'}``, with the keys of
            :data:`CONDITIONS`, ``level`` [e-] and ``sigma`` [pixel]; the other parts stay.

        Returns
        -------
        measured : MeasuredTable
            The same table with the changed condition.

        Raises
        ------
        RecordingError
            A key is not known, or a value is not such a quantity.
        """
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
        Quantities with units, with the keys of :data:`CONDITIONS`; ``sigma``, a width from 0.1 to
        10 pixels, and ``level``, the charge in every pixel about which a response was measured, 0 e-
        or more, may have none.

    Returns
    -------
    fields : dict of str to float
        Voltages [V], temperature [K], wavelength [nm] and level [e-], as :class:`Condition` has them.
    sigma : float or None
        The width [pixel]; None where it is not given.

    Raises
    ------
    RecordingError
        A key is not known, or a value is not such a quantity.

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
            if key == "level":
                fields[key] = _electrons(text)
                continue
            kind, factor = CONDITIONS[key]
            fields[key] = round(to_internal(text, kind) * factor, 9)
            if not np.isfinite(fields[key]):
                raise RecordingError(f"{key} = {text!r} must be finite")
        except KeyError:
            raise RecordingError(
                f"{key!r} is not a condition; conditions are {', '.join(CONDITIONS)}, level, sigma"
            ) from None
        except DeviceError as error:
            raise RecordingError(f"{key}: {error}") from None
        except RecordingError:
            raise
        except ValueError:
            raise RecordingError(
                f"{key} = {text!r} is not a number of pixels, such as 1.02"
            ) from None
    return fields, sigma


def _electrons(text: str) -> float:
    try:
        level = float(text.removesuffix("e-").strip())
    except ValueError:
        level = -1.0
    if not 0 <= level <= HIGHEST_LEVEL:
        raise RecordingError(
            f"level = {text!r} must be the charge in every pixel, from 0 to {HIGHEST_LEVEL:g} e-, such "
            "as 40000"
        )
    return level


def read_measured(path: str | os.PathLike[str]) -> MeasuredTable:
    r"""Read measured a_ij, slopes, saturation levels or diffusion widths.

    Parameters
    ----------
    path : path-like
        Table of a_ij (:func:`~bfsensor.recording.read_area_changes`), LSST's photon transfer
        dataset, or a table by setting (:func:`~bfsensor.recording.read_setting_table`).  The
        header of an ECSV file may have an entry ``conditions``: quantities with units such as
        ``{back_bias: -60 V, wavelength: 620 nm}``, of back_bias, gate_high, gate_low, temperature
        and wavelength, ``level`` [e-], and ``sigma``, the width of spots [pixel].

    Returns
    -------
    measured : MeasuredTable
        The table with its condition.

    Raises
    ------
    RecordingError
        The file does not exist, is of none of these kinds, or has values that cannot be used.

    Examples
    --------
    >>> import tempfile
    >>> text = "back_bias,slope,slope_error,axis\n-60,0.71,0.09,x\n-60,0.92,0.07,y\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "slopes.csv"
    ...     _ = path.write_text(text)
    ...     found = read_measured(path).at({"wavelength": "620 nm"})
    >>> found.table.values.tolist(), str(found.condition)
    ([0.71, 0.92], '620 nm')
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
            f"{path}: the table has covariances by level; fit their a_ij first, in Python "
            "bfsensor.measure.fit_covariances, and give a table of them with the columns "
            "i_serial, j_parallel, cov_per_e, err_per_e"
        )
    else:
        raise RecordingError(
            f"{path}: neither a_ij (columns i_serial, j_parallel, cov_per_e, err_per_e) nor "
            "slopes (slope, axis), saturation or diffusion by setting; its columns are "
            f"{', '.join(table.colnames)}"
        )
    try:
        return found.at(stated)
    except RecordingError as error:
        raise RecordingError(f"{path}: conditions: {error}") from None


def area_changes_of_amplifiers(path: Path) -> AreaChangeTable:
    """Mean a_ij of the amplifiers in LSST's photon transfer dataset, with the mean's error.

    Raises
    ------
    RecordingError
        Fewer than :data:`FEWEST` amplifiers have a finite matrix, or their matrices are equal.
    """
    a = np.asarray(PhotonTransferDataset.read(path).columns["A_MATRIX"], float)
    a = a[np.isfinite(a).all(axis=(1, 2))]
    if len(a) < FEWEST:
        raise RecordingError(
            f"{path}: {len(a)} amplifiers have a finite A_MATRIX; the error of their mean is taken "
            f"from their scatter, which needs {FEWEST}"
        )
    errors = a.std(axis=0, ddof=1) / np.sqrt(len(a))
    if not np.all(errors > 0):
        raise RecordingError(
            f"{path}: A_MATRIX is the same for all amplifiers in some lags: their scatter gives no "
            "error"
        )
    return AreaChangeTable(path, a.mean(axis=0), errors, np.isfinite(errors))
