"""What a sweep of a device gives: a table of rows, its file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from astropy.table import Column, Table
from numpy.typing import NDArray

from bfsensor.errors import SweepError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.sweeps.axes import Swept
from bfsensor.typing import FloatArray

LAGS = 3
"""Lags 0 to 2 in x and in y."""

SCHEMA = "bfsensor-sweep-1"

_DEFINITION = (
    "a_ij = (area change of the pixel at lag i in x (serial), j in y (parallel)) / (nominal area) "
    "per electron by which one pixel exceeds all others, which hold 'level' electrons, over a "
    "charge of 'step' electrons: the differential response, which flats see; a_00 is negative"
)
_AREAS = (
    "area_ij = area change [um2] of the pixel at lag (i, j) from one pixel of 'full_pixel' "
    "electrons among empty ones"
)
_ERRORS = (
    "a_ij_error = a_ij times the relative difference of that lag between 'cells' and "
    "'error_cells' cells a pixel, of the device as given: one estimate for all rows, and most of "
    "it common to them"
)
_LIGHT = (
    "light without a wavelength converts at the back surface; of one wavelength by the absorption "
    "at the temperature of the row"
)


class SweepRow(NamedTuple):
    """Response (3, 3), areas (3, 3), full well, cost, iteration error and reason of a point."""

    a: FloatArray
    areas: FloatArray
    full_well: float
    cpu_seconds: float
    iteration: float
    reason: str


@dataclass(frozen=True, eq=False)
class DeviceSweep:
    """Response of flats at every point of a sweep.

    Attributes
    ----------
    rows : astropy.table.Table
        One row a point: the swept quantities under their short names with units; ``a_ij`` and
        ``a_ij_error`` [1/e-] for i, j from 0 to 2; ``area_ij`` [um2] where a full pixel was
        asked for; ``full_well`` [e-]; ``iteration_error``, a bound [1/e-]; ``cpu`` [s];
        ``reason``, empty where there is an answer.
    swept : tuple of str
        Names of the columns that were swept, the last one fastest.
    """

    rows: Table
    swept: tuple[str, ...]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DeviceSweep):
            return NotImplemented
        return (
            self.swept == other.swept
            and self.rows.colnames == other.rows.colnames
            and dict(self.rows.meta) == dict(other.rows.meta)
            and all(_same(self.rows[n], other.rows[n]) for n in self.rows.colnames)
        )

    @classmethod
    def make(
        cls,
        found: Sequence[SweepRow],
        mesh: FloatArray,
        swept: Sequence[Swept],
        places: Sequence[Sequence[int]],
        meta: Mapping[str, Any],
    ) -> DeviceSweep:
        """Make the rows of points.

        Parameters
        ----------
        found : sequence of SweepRow
            One a point.
        mesh : ndarray, shape (3, 3)
            Relative error of the a_ij by lag, ``[j, i]``; nan where it is not known.
        swept : sequence of Swept
            The quantities.
        places : sequence of sequence of int
            For each point, the place of the value of every quantity.
        meta : mapping
            Entries for the header.
        """
        shorts = [one.short for one in swept]
        names = [
            one.name if shorts.count(one.short) > 1 else one.short for one in swept
        ]  # fmt: skip
        rows = Table()
        for k, (name, one) in enumerate(zip(names, swept, strict=True)):
            values = [one.values[place[k]] for place in places]
            rows[name] = Column(values, unit=one.unit or None, description=one.name)
        a, areas = (np.array([getattr(f, n) for f in found]) for n in ("a", "areas"))
        for j, i in np.ndindex(LAGS, LAGS):
            rows[f"a_{i}{j}"] = Column(a[:, j, i], unit="electron-1")
            rows[f"a_{i}{j}_error"] = Column(
                np.abs(a[:, j, i]) * mesh[j, i], unit="electron-1"
            )
        full = bool(meta.get("full_pixel"))
        if full:
            for j, i in np.ndindex(LAGS, LAGS):
                rows[f"area_{i}{j}"] = Column(areas[:, j, i], unit="um2")
        rows["full_well"] = Column([f.full_well for f in found], unit="electron")
        rows["iteration_error"] = Column([f.iteration for f in found], unit="electron-1")
        rows["cpu"] = Column([f.cpu_seconds for f in found], unit="s")
        rows["reason"] = Column([f.reason for f in found], dtype=str)
        rows.meta = {
            "schema": SCHEMA, "definition": _DEFINITION, "errors": _ERRORS, "light": _LIGHT,
            **({"areas": _AREAS} if full else {}), **meta, "swept": names,
        }  # fmt: skip
        return cls(rows, tuple(names))

    @property
    def a(self) -> FloatArray:
        """a_ij [1/e-], shape (points, 3, 3), ``[:, j, i]``; nan where refused."""
        return self._grid("a_{i}{j}")

    @property
    def errors(self) -> FloatArray:
        """Numerical errors of :attr:`a`, same shape."""
        return self._grid("a_{i}{j}_error")

    @property
    def areas(self) -> FloatArray:
        """Area changes around one full pixel [um^2], shape (points, 3, 3).

        Raises
        ------
        SweepError
            The sweep was made without.
        """
        if "area_00" not in self.rows.colnames:
            raise SweepError(
                "the sweep has no areas of a full pixel; ask for them: full_pixel"
            )
        return self._grid("area_{i}{j}")

    @property
    def refused(self) -> NDArray[np.bool_]:
        """Points without an answer."""
        return np.array([bool(reason) for reason in self.rows["reason"]])

    def _grid(self, pattern: str) -> FloatArray:
        values = [
            [np.asarray(self.rows[pattern.format(i=i, j=j)], float) for i in range(LAGS)]
            for j in range(LAGS)
        ]
        return np.moveaxis(np.array(values), 2, 0)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write an ECSV file, whole or not at all.

        Raises
        ------
        SweepError
            The file exists and ``overwrite`` is not set, or it cannot be written.
        """
        refuse_existing(path, overwrite, SweepError)
        with written_whole(path, SweepError) as beside:
            self.rows.write(beside, format="ascii.ecsv", overwrite=True)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> DeviceSweep:
        """Read what :meth:`write` wrote.

        Raises
        ------
        SweepError
            No such file, or not of this kind.
        """
        try:
            rows = Table.read(path, format="ascii.ecsv")
        except (OSError, ValueError) as error:
            raise SweepError(f"{path}: not a sweep: {error}") from None
        if rows.meta.get("schema") != SCHEMA:
            raise SweepError(
                f"{path}: schema {rows.meta.get('schema')!r} is not {SCHEMA!r}: not a sweep"
            )
        if hasattr(rows["reason"], "mask"):  # empty texts are read as missing
            rows["reason"] = rows["reason"].filled("")
        rows.meta = dict(rows.meta)
        return cls(rows, tuple(rows.meta["swept"]))


def _same(one: Column, two: Column) -> bool:
    """Equal values, nan equal to nan, and units."""
    numbers = one.dtype.kind == "f"
    equal = np.array_equal(np.asarray(one), np.asarray(two), equal_nan=numbers)
    return bool(equal) and one.unit == two.unit
