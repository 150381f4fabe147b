"""Measured numbers that a device is fitted to, as arrays with errors and conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.device.condition import Condition
from bfsensor.errors import FitError
from bfsensor.fit.spot_response import SIGMA
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.recording.tables.measured import MeasuredTable
from bfsensor.recording.tables.setting_tables import SettingTable
from bfsensor.typing import FloatArray

KINDS = ("areas", "slopes", "saturation", "diffusion")

UNITS = {
    "areas": "1 / electron",
    "slopes": "%",
    "saturation": "electron",
    "diffusion": "um",
}

LAGS = 4
"""Largest lag that is fitted: beyond, the published a_ij are noise."""

ASSUMED = {"saturation": 0.02, "diffusion": 0.05}
"""Relative errors where a table has none: an assumption, and said to be one."""

MODEL_ERROR = {"slopes": 0.04}
"""Relative error of a prediction, added in quadrature.  The closed form of slopes takes the
response of a flat of 40,000 e-; the direct simulation of spots in the ITL device has 4, -1; 5, 4;
4, 0 % more in x, y at three settings (``validation/results/spot_slopes.ecsv``)."""


@dataclass(frozen=True, eq=False)
class DataSet:
    """Numbers of one kind, measured together.

    Attributes
    ----------
    name : str
        For tables and figures.
    kind : str
        'areas' [1/e-], 'slopes' [% of a pixel for 50,000 e-], 'saturation' [e-] or
        'diffusion' [um].
    values, errors : ndarray, shape (n,)
        Errors as stated, with what is added for the prediction's own.
    conditions : tuple of Condition, length n
        None in a field: not stated, the device's own value holds, free or not.
    places : ndarray of int, shape (n, 2)
        Lag (i, j) of areas; (0, 0) and (1, 0) for slopes in x and y.
    fitted : bool
        False: only held against the fit.
    scaled : bool
        Whether the scale of the errors is estimated.
    sigma : float
        Width of the spots of slopes [pixel].
    notes : tuple of str
        What was assumed.
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
            raise FitError(f"{self.name}: holds nothing to fit")
        shapes = self.errors.shape, len(self.conditions), self.places.shape
        if shapes != ((n,), n, (n, 2)):
            raise FitError(
                f"{self.name}: {n} values, errors {shapes[0]}, {shapes[1]} conditions and places "
                f"{shapes[2]} do not belong together"
            )
        if not (np.all(np.isfinite(self.values)) and np.all(np.isfinite(self.errors))):
            raise FitError(f"{self.name}: values or errors are not finite")
        if not np.all(self.errors > 0):
            raise FitError(f"{self.name}: errors must be above 0")

    @property
    def labels(self) -> tuple[str, ...]:
        """What each number is, for tables."""
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
        For tables and figures.
    a, errors : array_like, shape (ny, nx)
        [j, i], from lag (0, 0) [1/e-]; nan where not measured.
    condition : Condition, optional
        Voltages, wavelength, temperature, where stated.
    independent : array_like of bool, shape (ny, nx), optional
        False: set by a sum rule, and left out.
    lags : int
        Largest lag that is kept.
    fitted, scaled : bool
        As in :class:`DataSet`.

    Returns
    -------
    DataSet

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
            f"{name}: a_ij {values.shape} and errors {sigma.shape} must be (ny, nx)"
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
    """Make a data set of what was read.

    Parameters
    ----------
    measured : MeasuredTable
        Table and condition; a row's own setting comes before that of the file.
    name : str, optional
        [name of the file].
    lags, fitted, scaled
        As for :func:`area_data`.

    Returns
    -------
    DataSet
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
    """Give some of the numbers as a data set of their own.

    Parameters
    ----------
    data : DataSet
        The numbers.
    keep : sequence of bool
        Of each number, whether it is kept.
    name : str
        Of the new data set.

    Returns
    -------
    DataSet
    """
    at = np.flatnonzero(keep)
    return DataSet(
        name, data.kind, data.values[at], data.errors[at],
        tuple(data.conditions[k] for k in at), data.places[at], data.fitted, data.scaled,
        data.sigma, data.notes,
    )  # fmt: skip


def _joined(own: Condition, common: Condition) -> Condition:
    """Setting of a row, with that of the file where the row says nothing."""
    fields = ("wavelength", "filter", "temperature", "back_bias", "gate_high", "gate_low")
    return Condition(
        **{
            key: getattr(common, key) if getattr(own, key) is None else getattr(own, key)
            for key in fields
        }
    )


def _errors(table: SettingTable) -> tuple[FloatArray, tuple[str, ...]]:
    """Errors of a table's values, and what was assumed of them."""
    notes = []
    errors = table.errors.copy()
    lost = ~np.isfinite(errors)
    if lost.any():
        part = ASSUMED.get(table.kind)
        if part is None:
            raise FitError(f"{table.path}: {table.kind} without errors")
        errors[lost] = part * np.abs(table.values[lost])
        notes.append(f"{table.path.name}: no errors, {100 * part:g} % assumed")
    part = MODEL_ERROR.get(table.kind)
    if part:
        errors = np.hypot(errors, part * table.values)
        notes.append(
            f"{table.path.name}: {100 * part:g} % added for the closed form's own error"
        )
    return errors, tuple(notes)
