"""Tables of one number a setting: B-F slopes, saturation levels, diffusion widths."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import ascii as text_tables
from astropy.io.ascii import InconsistentTableError
from astropy.table import Table

from bfsensor.device.condition import Condition
from bfsensor.errors import RecordingError
from bfsensor.recording.tables.covariance_tables import floats
from bfsensor.typing import FloatArray

SETTINGS = {
    "back_bias": ("back_bias", "vbb", "Vbb_V"),
    "gate_high": ("gate_high", "Vpar_hi_V"),
    "gate_low": ("gate_low", "Vpar_lo_V"),
    "wavelength": ("wavelength", "wavelength_nm"),
    "temperature": ("temperature", "temperature_K"),
}
"""Columns of a setting [V, nm, K], by the fields of a condition."""


class _Form(NamedTuple):
    """Columns that make a kind: value, error, and whether each row is of one axis."""

    values: tuple[str, ...]
    errors: tuple[str, ...]
    by_axis: bool


KINDS = {
    "slopes": _Form(("slope", "meas_pct_per_50ke"), ("slope_error", "meas_err"), True),
    "saturation": _Form(("saturation", "sat_level_e"), ("saturation_error",), False),
    "diffusion": _Form(("diffusion",), ("diffusion_error",), False),
}


@dataclass(frozen=True, eq=False)
class SettingTable:
    """Measured numbers, each at a setting of its own.

    Attributes
    ----------
    path : Path
        Where they came from.
    kind : str
        'slopes' [% of a pixel for 50,000 e- in the central pixel], 'saturation' [e-] or
        'diffusion' [um].
    values, errors : ndarray, shape (n,)
        Errors nan where not given.
    axes : tuple of str
        'x' or 'y' of each slope; '' for other kinds.
    conditions : tuple of Condition
        None where the table does not say.
    meta : mapping
        Header entries of an ECSV file.
    warnings : tuple of str
    """

    path: Path
    kind: str
    values: FloatArray
    errors: FloatArray
    axes: tuple[str, ...]
    conditions: tuple[Condition, ...]
    meta: Mapping[str, object]
    warnings: tuple[str, ...] = ()


def is_setting_table(names: list[str]) -> str | None:
    """Give the kind that columns stand for; None where they are no such table.

    Examples
    --------
    >>> is_setting_table(["Vpar_lo_V", "Vpar_hi_V", "sat_level_e"])
    'saturation'
    """
    for kind, form in KINDS.items():
        axis = not form.by_axis or "axis" in names
        if axis and any(name in names for name in form.values):
            return kind
    return None


def read_setting_table(path: str | os.PathLike[str]) -> SettingTable:
    """Read slopes, saturation levels or diffusion widths, comma-separated or ECSV.

    Parameters
    ----------
    path : path-like
        With the columns of one of :data:`KINDS` and, where known, of :data:`SETTINGS`; slopes
        with ``axis``, 'x' or 'y'.

    Returns
    -------
    SettingTable

    Raises
    ------
    RecordingError
        No such column, an axis that is neither, or a value that is not finite.

    Notes
    -----
    Rows that repeat a measurement (the published slopes stand beside two simulations each)
    are read once.
    """
    path = Path(path)
    table = read_text(path)
    kind = is_setting_table(table.colnames)
    if kind is None:
        words = ", ".join(" or ".join(form.values) for form in KINDS.values())
        raise RecordingError(
            f"{path}: none of the columns {words} among {', '.join(table.colnames)}"
        )
    form = KINDS[kind]
    values = floats(table, next(n for n in form.values if n in table.colnames))
    errors = floats(table, next((n for n in form.errors if n in table.colnames), ""))
    if not np.all(np.isfinite(values)):
        raise RecordingError(
            f"{path}: {int(np.sum(~np.isfinite(values)))} values not finite"
        )
    if np.any(errors <= 0):
        raise RecordingError(f"{path}: errors must be above 0")
    axes = [str(a) for a in table["axis"]] if form.by_axis else [""] * len(table)
    wrong = sorted(set(axes) - {"x", "y", ""})
    if wrong:
        raise RecordingError(f"{path}: axis = {wrong[0]!r} is neither 'x' nor 'y'")
    columns = {
        key: floats(table, next((n for n in names if n in table.colnames), ""))
        for key, names in SETTINGS.items()
    }
    kept: dict[tuple[object, ...], int] = {}
    for row in range(len(table)):
        key = (*(column[row] for column in columns.values()), axes[row], values[row])
        # nan is not equal to itself.
        kept.setdefault(tuple(None if v != v else v for v in key), row)
    rows = sorted(kept.values())
    stated: list[dict[str, Any]] = [
        {k: float(c[row]) for k, c in columns.items() if np.isfinite(c[row])}
        for row in rows
    ]
    conditions = tuple(Condition(**fields) for fields in stated)
    warnings = [] if np.all(np.isfinite(errors)) else ["no errors: they have to be assumed"]
    if len(rows) < len(table):
        warnings.append(f"{len(table) - len(rows)} rows repeat a measurement: read once")
    return SettingTable(
        path, kind, values[rows], errors[rows], tuple(axes[row] for row in rows), conditions,
        dict(table.meta), tuple(warnings),
    )  # fmt: skip


def read_text(path: Path) -> Table:
    """Read a comma-separated or ECSV table, lines with # passed over in the former.

    Raises
    ------
    RecordingError
        It cannot be read so.
    """
    try:
        form = "ecsv" if path.suffix == ".ecsv" else "csv"
        return text_tables.read(path, format=form, comment="#")
    except (OSError, ValueError, InconsistentTableError) as error:
        line = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: cannot be read: {line}") from None
