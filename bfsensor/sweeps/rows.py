"""Result of a device sweep: a table with one row a point, and its ECSV file."""

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
from bfsensor.text_files import UnreadableTextError, read_ecsv
from bfsensor.typing import FloatArray

LAGS = 3
"""Number of lags in x and in y, from 0.

Chosen: a_ij at larger lags are below 1 % of a_00.  Twice as many would need a table that reaches
further than the 4 pixels of a point's."""

SCHEMA = "bfsensor-sweep-1"
"""Name of the file's schema; a file with another one is refused."""

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
    """Results of one point of a sweep.

    Attributes
    ----------
    a, areas : ndarray, shape (3, 3)
        a_ij [1/e-] and area changes around one full pixel [um^2], ``[j, i]``; nan where missing.
    full_well : float
        Charge at which a pixel spills [e-].
    cpu_seconds : float
        CPU time [s].
    iteration : float
        Bound on the error of an a_ij by the solver's iteration [1/e-].
    reason : str
        Reason of a refusal; empty where there is a response.

    Examples
    --------
    >>> zeros = np.zeros((LAGS, LAGS))
    >>> SweepRow(zeros, zeros, 1.5e5, 2.0, 1e-10, "").full_well
    150000.0
    """

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
        ``reason`` of a refusal, else empty.  The header defines the columns.
    swept : tuple of str
        Names of the swept columns, the last one varying fastest.
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
        """Assemble the table from the results of all points.

        Parameters
        ----------
        found : sequence of SweepRow
            Results, one a point.
        mesh : ndarray, shape (3, 3)
            Relative error of the a_ij by lag, ``[j, i]``; nan where it is not known.
        swept : sequence of Swept
            The axes.
        places : sequence of sequence of int
            For each point, an index into every axis's values.
        meta : mapping
            Further entries of the header.

        Returns
        -------
        DeviceSweep
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
        """Responses a_ij [1/e-], shape (points, 3, 3), ``[:, j, i]``; nan where refused."""
        return self._grid("a_{i}{j}")

    @property
    def errors(self) -> FloatArray:
        """Numerical errors of :attr:`a` [1/e-], same shape; nan where not known."""
        return self._grid("a_{i}{j}_error")

    @property
    def areas(self) -> FloatArray:
        """Area changes around one full pixel [um^2], shape (points, 3, 3).

        Raises
        ------
        SweepError
            The sweep was made without a full pixel.
        """
        if "area_00" not in self.rows.colnames:
            raise SweepError(
                "the sweep has no area changes around a full pixel; give its charge as full_pixel"
            )
        return self._grid("area_{i}{j}")

    @property
    def refused(self) -> NDArray[np.bool_]:
        """Whether each point was refused, shape (points,)."""
        return np.array([bool(reason) for reason in self.rows["reason"]])

    def _grid(self, pattern: str) -> FloatArray:
        """Columns of all lags as an array ``[:, j, i]``; ``pattern`` holds {i} and {j}."""
        values = [
            [np.asarray(self.rows[pattern.format(i=i, j=j)], float) for i in range(LAGS)]
            for j in range(LAGS)
        ]
        return np.moveaxis(np.array(values), 2, 0)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write an ECSV file, whole or not at all.

        Parameters
        ----------
        path : path-like
            Where to.
        overwrite : bool
            Replace an existing file.

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
        """Read the file of a sweep.

        Parameters
        ----------
        path : path-like
            File that :meth:`write` wrote.

        Returns
        -------
        DeviceSweep

        Raises
        ------
        SweepError
            No such file, not ECSV, or of another schema; the message names the file.
        """
        try:
            rows = read_ecsv(path)
        except UnreadableTextError as error:
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
    """Whether two columns have equal values, nan equal to nan, and equal units."""
    numbers = one.dtype.kind == "f"
    equal = np.array_equal(np.asarray(one), np.asarray(two), equal_nan=numbers)
    return bool(equal) and one.unit == two.unit
