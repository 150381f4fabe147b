"""Tables with one number for each setting: slopes, full wells, diffusion, full depletion."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.errors import RecordingError
from bfsensor.recording.tables.text_tables import numbers, read_text, refuse_misspelt
from bfsensor.typing import FloatArray

SETTINGS = {
    "back_bias": ("back_bias", "vbb", "Vbb_V"),
    "gate_high": ("gate_high", "Vpar_hi_V"),
    "gate_low": ("gate_low", "Vpar_lo_V"),
    "wavelength": ("wavelength", "wavelength_nm"),
    "temperature": ("temperature", "temperature_K"),
}
"""Names of the columns of a setting [V, nm, K], by the fields of a condition."""


class _Form(NamedTuple):
    """Names of a kind's columns for value and error, and whether a column ``axis`` is needed."""

    values: tuple[str, ...]
    errors: tuple[str, ...]
    by_axis: bool


KINDS = {
    "slopes": _Form(("slope", "meas_pct_per_50ke"), ("slope_error", "meas_err"), True),
    "saturation": _Form(("saturation", "sat_level_e"), ("saturation_error",), False),
    "diffusion": _Form(("diffusion",), ("diffusion_error",), False),
    "depletion": _Form(("full_depletion",), ("full_depletion_error",), False),
}
"""Columns of each kind of table, in the units of :class:`SettingTable`."""


@dataclass(frozen=True, eq=False)
class SettingTable:
    """Measured slopes, saturation levels, diffusion widths or full-depletion voltages.

    Each value has its own condition.

    Attributes
    ----------
    path : Path
        File of the table.
    kind : str
        'slopes', rise of a spot's rms width for 50,000 e- in its central pixel [% of a pixel],
        'saturation' [e-], 'diffusion' [um] or 'depletion', the back bias from which on all of the
        silicon is depleted [V, signed as in device files].
    values, errors : ndarray, shape (n,)
        Values and their standard errors; errors are nan where the table has none.
    axes : tuple of str
        'x' or 'y' of each slope; '' for other kinds.
    conditions : tuple of Condition
        Condition of each value; a field is None where the table has no column for it.
    meta : mapping
        Header entries of an ECSV file.
    warnings : tuple of str
        Warnings about missing errors and repeated rows.

    Examples
    --------
    :func:`read_setting_table` makes one; its example shows values and conditions.
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
    """Give the kind of table that has these columns; None where none has.

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
    r"""Read slopes, saturation levels, diffusion widths or full-depletion voltages, CSV or ECSV.

    Parameters
    ----------
    path : path-like
        Table with the columns of one of :data:`KINDS`: ``slope`` [% of a pixel for 50,000 e-] with
        ``axis``, 'x' or 'y'; ``saturation`` [e-]; ``diffusion`` [um]; or ``full_depletion`` [V]; each
        may have ``..._error``.  Columns of :data:`SETTINGS` are optional: ``back_bias``, ``gate_high``,
        ``gate_low`` [V], ``wavelength`` [nm], ``temperature`` [K].

    Returns
    -------
    table : SettingTable
        The values with their conditions.

    Raises
    ------
    RecordingError
        The file cannot be read or has no such column, an axis is neither 'x' nor 'y', a value
        is not finite, or an error is not above 0.

    Notes
    -----
    Rows that repeat a measurement are read once: published slopes, for instance, stand twice
    where they are compared with two simulations.

    Examples
    --------
    >>> import tempfile
    >>> text = "gate_low,gate_high,saturation,saturation_error\n-8,4,180e3,5e3\n-8,3,150e3,5e3\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "wells.csv"
    ...     _ = path.write_text(text)
    ...     table = read_setting_table(path)
    >>> table.kind, table.values.tolist(), [str(one) for one in table.conditions]
    ('saturation', [180000.0, 150000.0], ['gates -8/4 V', 'gates -8/3 V'])
    """
    path = Path(path)
    table = read_text(path)
    kind = is_setting_table(table.colnames)
    if kind is None:
        words = ", ".join(" or ".join(form.values) for form in KINDS.values())
        raise RecordingError(
            f"{path}: none of the columns {words} (slopes also need axis) among "
            f"{', '.join(table.colnames)}"
        )
    form = KINDS[kind]
    known = [*form.values, *form.errors, *(n for names in SETTINGS.values() for n in names)]
    refuse_misspelt(path, table.colnames, [*known, "axis"])
    values = numbers(
        path, table, next(n for n in form.values if n in table.colnames),
        advice="; leave these rows out",
    )  # fmt: skip
    errors = numbers(
        path, table, next((n for n in form.errors if n in table.colnames), ""), above=0.0,
        blank=True,
    )  # fmt: skip
    axes = [str(a) for a in table["axis"]] if form.by_axis else [""] * len(table)
    wrong = sorted(set(axes) - {"x", "y", ""})
    if wrong:
        raise RecordingError(f"{path}: axis = {wrong[0]!r} is neither 'x' nor 'y'")
    columns = {
        key: numbers(
            path,
            table,
            next((n for n in names if n in table.colnames), ""),
            blank=True,
            above=0.0 if key in ("wavelength", "temperature") else -np.inf,
        )
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
    warnings = []
    if not np.all(np.isfinite(errors)):
        warnings.append(
            f"values without errors: add a column {form.errors[0]}, else errors are assumed"
        )
    if len(rows) < len(table):
        warnings.append(
            f"{len(table) - len(rows)} rows repeat a measurement and are not read"
        )
    return SettingTable(
        path, kind, values[rows], errors[rows], tuple(axes[row] for row in rows), conditions,
        dict(table.meta), tuple(warnings),
    )  # fmt: skip
