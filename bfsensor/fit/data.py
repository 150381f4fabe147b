"""Data sets that a device is fitted to: measured numbers with errors and conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.device.condition import Condition
from bfsensor.errors import FitError
from bfsensor.fit.spot_response import SIGMA
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.recording.tables.measured import MeasuredTable
from bfsensor.recording.tables.setting_tables import SettingTable
from bfsensor.typing import FloatArray

KINDS = ("areas", "slopes", "saturation", "diffusion", "depletion")
"""Kinds of data sets: a_ij, B-F slopes, saturation levels, diffusion widths, full-depletion voltages."""

UNITS = {
    "areas": "1 / electron",
    "slopes": "%",
    "saturation": "electron",
    "diffusion": "um",
    "depletion": "V",
}
"""Unit of the numbers of each kind; slopes are per cent of a pixel for 50,000 e-."""

LAGS = 4
"""Largest lag of a_ij that is fitted by default [pixel].

Chosen: beyond it the published a_ij are noise; twice as large, 56 more numbers are fitted."""

ASSUMED = {"saturation": 0.02, "diffusion": 0.05, "depletion": 0.05}
"""Relative errors of values that have none in their table.

Chosen; a note of the fit states it.  Twice as large, such values weigh a quarter as much, unless the
scale of the set's errors is fitted, which then halves."""

MODEL_ERROR = {"slopes": 0.04}
"""Relative error of predictions of a kind, added to the measured error in quadrature.

Measured (``validation/results/spot_slopes.ecsv``): the closed form of slopes takes the response of a
flat of 40,000 e-; the direct simulation of spots in the ITL device gives slopes larger by 4, -1; 5,
4; 4, 0 % in x, y at three settings."""


@dataclass(frozen=True, eq=False)
class DataSet:
    """Measured numbers of one kind with errors and conditions.

    Parameters
    ----------
    name : str
        Name in tables and figures.
    kind : str
        'areas' [1/e-], 'slopes' [% of a pixel for 50,000 e-], 'saturation' [e-] or
        'diffusion' [um] or 'depletion' [V].
    values, errors : ndarray, shape (n,)
        Values in the unit of the kind, and their standard errors, above 0, including that of the
        prediction (:data:`MODEL_ERROR`).
    conditions : tuple of Condition, length n
        Voltages, wavelength and temperature of each number; a field that is None was not stated,
        and the value of the device holds, free or not.
    places : ndarray of int, shape (n, 2)
        Lag (i, j) of areas; (0, 0) and (1, 0) for slopes in x and y; (0, 0) for other kinds.
    fitted : bool
        False: the numbers are only compared with the fit.
    scaled : bool
        Whether a common factor on the errors is estimated.
    sigma : float
        Gaussian width of the spots of slopes [pixel], 0.3 to 3.
    notes : tuple of str
        Assumptions about the numbers.

    Raises
    ------
    FitError
        The kind is unknown, arrays do not match, or values or errors are not valid.

    Examples
    --------
    >>> DataSet("one", "saturation", np.array([1.5e5]), np.array([3e3]), (Condition(),),
    ...         np.zeros((1, 2), int)).fitted
    True
    """

    name: str
    kind: str
    values: FloatArray
    errors: FloatArray
    conditions: tuple[Condition, ...]
    places: NDArray[np.int64]
    fitted: bool = True
    scaled: bool = True
    sigma: float = SIGMA
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FitError(f"{self.name}: kind = {self.kind!r} must be one of {KINDS}")
        n = len(self.values)
        if not n:
            raise FitError(f"{self.name}: no values to fit")
        shapes = self.errors.shape, len(self.conditions), self.places.shape
        if shapes != ((n,), n, (n, 2)):
            raise FitError(
                f"{self.name}: {n} values need as many errors, conditions and places (n, 2), not "
                f"errors {shapes[0]}, {shapes[1]} conditions and places {shapes[2]}"
            )
        if not (np.all(np.isfinite(self.values)) and np.all(np.isfinite(self.errors))):
            raise FitError(f"{self.name}: values or errors are not finite")
        if not np.all(self.errors > 0):
            raise FitError(f"{self.name}: errors must be above 0")

    @property
    def labels(self) -> tuple[str, ...]:
        """Label of each number for tables: its lag, or its axis and condition."""
        if self.kind == "areas":
            return tuple(f"({i},{j})" for i, j in self.places)
        words = [str(condition) for condition in self.conditions]
        if self.kind == "slopes":
            return tuple(
                f"{'xy'[axis]} {word}"
                for axis, word in zip(self.places[:, 0], words, strict=True)
            )
        return tuple(words)


def area_data(
    name: str,
    a: ArrayLike,
    errors: ArrayLike,
    *,
    condition: Condition | None = None,
    independent: ArrayLike | None = None,
    lags: int = LAGS,
    fitted: bool = True,
    scaled: bool = True,
) -> DataSet:
    """Make a data set of measured a_ij.

    Parameters
    ----------
    name : str
        Name in tables and figures.
    a, errors : array_like, shape (ny, nx)
        Relative area changes per electron and their standard errors [1/e-], ``[j, i]`` from lag
        (0, 0); nan where not measured.
    condition : Condition, optional
        Voltages, wavelength and temperature, as far as stated.
    independent : array_like of bool, shape (ny, nx), optional
        False for a value computed from others by a sum rule, which is left out.
    lags : int
        Largest lag that is kept [pixel], 0 or more.
    fitted, scaled : bool
        As in :class:`DataSet`.

    Returns
    -------
    data : DataSet
        Kind 'areas', nearest lags first.

    Raises
    ------
    FitError
        Arrays are not of one shape (ny, nx), no lag is left, or errors are not above 0.

    Examples
    --------
    >>> a = np.array([[-1e-6, 1e-7], [2e-7, 5e-8]])
    >>> data = area_data("two", a, 0.1 * abs(a), independent=[[False, True], [True, True]])
    >>> data.labels
    ('(1,0)', '(0,1)', '(1,1)')
    """
    values, sigma = np.asarray(a, float), np.asarray(errors, float)
    if values.ndim != 2 or sigma.shape != values.shape:
        raise FitError(
            f"{name}: a_ij {values.shape} and errors {sigma.shape} must both be (ny, nx)"
        )
    used = np.isfinite(values) & np.isfinite(sigma)
    if independent is not None:
        used &= np.asarray(independent, bool)
    used[lags + 1 :], used[:, lags + 1 :] = False, False
    j, i = np.nonzero(used)
    near = np.lexsort((-i, np.hypot(i, j)))
    j, i = j[near], i[near]
    at = condition or Condition()
    return DataSet(
        name, "areas", values[j, i], sigma[j, i], (at,) * len(i), np.column_stack([i, j]),
        fitted, scaled,
    )  # fmt: skip


def data_set(
    measured: MeasuredTable,
    *,
    name: str | None = None,
    lags: int = LAGS,
    fitted: bool = True,
    scaled: bool = True,
) -> DataSet:
    r"""Make a data set of a measured table.

    Parameters
    ----------
    measured : MeasuredTable
        Table and condition; the setting of a row takes precedence over that of the file.
    name : str, optional
        Name in tables and figures; by default that of the file.
    lags : int
        Largest lag of a_ij that is kept [pixel].
    fitted, scaled : bool
        As in :class:`DataSet`.

    Returns
    -------
    data : DataSet
        Of the table's kind.

    Raises
    ------
    FitError
        The table states no errors, and none are assumed for its kind, or no value is left.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from bfsensor.recording.tables.measured import read_measured
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "saturation.csv"
    ...     _ = path.write_text("gate_high,saturation,saturation_error\n1,1.5e5,3e3\n")
    ...     data = data_set(read_measured(path))
    >>> data.kind, data.conditions[0].gate_high
    ('saturation', 1.0)
    """
    table = measured.table
    called = name or table.path.stem
    if isinstance(table, AreaChangeTable):
        return area_data(
            called, table.a, table.errors, condition=measured.condition,
            independent=table.independent, lags=lags, fitted=fitted, scaled=scaled,
        )  # fmt: skip
    conditions = tuple(_joined(one, measured.condition) for one in table.conditions)
    errors, notes = _errors(table)
    places = np.zeros((len(table.values), 2), np.int64)
    places[:, 0] = [axis == "y" for axis in table.axes]
    return DataSet(
        called, table.kind, table.values, errors, conditions, places, fitted, scaled,
        SIGMA if measured.sigma is None else measured.sigma, notes,
    )  # fmt: skip


def select(data: DataSet, keep: Sequence[bool] | NDArray[np.bool_], name: str) -> DataSet:
    """Select some of the numbers as a data set of their own.

    Parameters
    ----------
    data : DataSet
        Data set to select from; not changed.
    keep : sequence of bool
        Whether each number is kept; at least one.
    name : str
        Name of the new data set.

    Returns
    -------
    data : DataSet
        The selected numbers in their order.

    Raises
    ------
    FitError
        No number is kept.

    Examples
    --------
    >>> data = area_data("two", [[-1e-6, 1e-7]], [[1e-8, 1e-8]])
    >>> select(data, [True, False], "first").labels
    ('(0,0)',)
    """
    at = np.flatnonzero(keep)
    return DataSet(
        name, data.kind, data.values[at], data.errors[at],
        tuple(data.conditions[k] for k in at), data.places[at], data.fitted, data.scaled,
        data.sigma, data.notes,
    )  # fmt: skip


def apart_from_readout(data: DataSet, lags: int) -> tuple[DataSet, DataSet]:
    """Set aside the lags along a row, to which memory of the readout adds.

    Covariances that the readout makes follow the order in which pixels are read: they act at (1, 0),
    (2, 0) and further along a row, not across rows.  A free term at each of these lags takes its
    value out of the fit of a device; what the device then leaves there is the term.

    Parameters
    ----------
    data : DataSet
        Kind 'areas', fitted.
    lags : int
        Largest lag that is set aside [pixel], 1 or more.

    Returns
    -------
    device, readout : DataSet
        The lags that the device is fitted to, and those that are compared with it.

    Raises
    ------
    FitError
        The data are not a_ij, none lies at such a lag, or nothing else is left.

    Examples
    --------
    >>> a = np.array([[-1e-6, 1e-7, 3e-8], [2e-7, 5e-8, 1e-8]])
    >>> device, readout = apart_from_readout(area_data("two", a, 0.1 * abs(a)), 1)
    >>> device.labels, readout.labels
    (('(0,0)', '(0,1)', '(1,1)', '(2,0)', '(2,1)'), ('(1,0)',))
    """
    if data.kind != "areas":
        raise FitError(f"{data.name}: a readout acts on a_ij, not on {data.kind}")
    i, j = data.places.T
    along = (j == 0) & (i >= 1) & (i <= lags)
    if not along.any() or along.all():
        raise FitError(
            f"{data.name}: of {len(i)} lags {int(along.sum())} are (1,0) to ({lags},0); some must be, "
            "and others be left for the device"
        )
    return select(data, ~along, data.name), replace(
        select(data, along, f"{data.name}, readout"), fitted=False
    )


def _joined(own: Condition, common: Condition) -> Condition:
    """Condition of a row, completed by that of the file where the row states nothing."""
    fields = (
        "wavelength", "filter", "temperature", "back_bias", "gate_high", "gate_low", "level",
    )  # fmt: skip
    return Condition(
        **{
            key: getattr(common, key) if getattr(own, key) is None else getattr(own, key)
            for key in fields
        }
    )


def _errors(table: SettingTable) -> tuple[FloatArray, tuple[str, ...]]:
    """Errors of the values of a table, and notes on assumed or added ones."""
    notes = []
    errors = table.errors.copy()
    lost = ~np.isfinite(errors)
    if lost.any():
        part = ASSUMED.get(table.kind)
        if part is None:
            raise FitError(
                f"{table.path}: {int(lost.sum())} values of {table.kind} have no errors: add them"
            )
        errors[lost] = part * np.abs(table.values[lost])
        notes.append(f"{table.path.name}: no errors, {100 * part:g} % assumed")
    part = MODEL_ERROR.get(table.kind)
    if part:
        errors = np.hypot(errors, part * table.values)
        notes.append(
            f"{table.path.name}: {100 * part:g} % added for the closed form's own error"
        )
    return errors, tuple(notes)
