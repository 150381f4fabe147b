"""Tables of calibration files by column name, FITS or ECSV: what LSST's datasets share."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import numpy as np
from astropy import units
from astropy.io import fits
from astropy.io.fits.verify import VerifyWarning
from astropy.table import Table
from astropy.units import UnitsWarning
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.recording.raw.open_fits import open_fits

Columns = Mapping[str, NDArray[Any]]
Sides = Mapping[str, int]
_Kind = TypeVar("_Kind", bound="CalibrationTable")


@dataclass(frozen=True, eq=False)
class CalibrationTable:
    """Columns by the pipeline's names, a row for each amplifier, lags as [j, i].

    Attributes
    ----------
    columns : mapping of str to ndarray
        The first axis is the amplifier; matrices of lags are unfolded to (..., j, i).
    meta : mapping of str to value
        Cards of the header; kind, schema and version of the dataset are filled in.
    """

    columns: Columns
    meta: Mapping[str, Any] = field(default_factory=dict)

    OBSTYPE: ClassVar[str] = ""
    SCHEMA: ClassVar[str] = ""
    VERSION: ClassVar[float] = 1.0
    REQUIRED: ClassVar[tuple[str, ...]] = ()
    MATRICES: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    UNITS: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        meta = dict(self.meta)
        for key, value in (
            ("OBSTYPE", self.OBSTYPE),
            (f"{self.OBSTYPE}_SCHEMA", self.SCHEMA),
            (f"{self.OBSTYPE}_VERSION", self.VERSION),
        ):
            if look_up(meta, key, None) is None:
                meta[key] = value
        object.__setattr__(self, "columns", MappingProxyType(dict(self.columns)))
        object.__setattr__(self, "meta", MappingProxyType(meta))
        require(type(self).__name__, self.columns, self.REQUIRED)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CalibrationTable) or type(self) is not type(other):
            return NotImplemented
        return dict(self.meta) == dict(other.meta) and same(self.columns, other.columns)

    __hash__ = None  # type: ignore[assignment]

    @property
    def version(self) -> float:
        """Version of the format that the header names."""
        return float(look_up(self.meta, f"{self.OBSTYPE}_VERSION", self.VERSION))

    @classmethod
    def read(cls: type[_Kind], path: str | os.PathLike[str]) -> _Kind:
        """Read FITS, or ECSV where the name ends so.

        Parameters
        ----------
        path : path-like
            The file.

        Raises
        ------
        RecordingError
            Names the file and the column that is missing, of another unit or length, or
            the kind of dataset found instead.
        """
        tables = read_tables(path)
        kind = look_up(tables[0].meta, "OBSTYPE", None)
        if kind != cls.OBSTYPE:
            raise RecordingError(f"{path}: its OBSTYPE is {kind!r}, not {cls.OBSTYPE!r}")
        return cls._from_tables(str(path), tables)

    @classmethod
    def _from_tables(cls: type[_Kind], path: str, tables: list[Table]) -> _Kind:
        return cls(cls._unfold(path, tables[0]), tables[0].meta)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write FITS, or ECSV where the name ends so (beside, then renamed).

        Raises
        ------
        RecordingError
            The file exists and ``overwrite`` is not set, or cannot hold this.
        """
        write_tables(path, self._to_tables(), overwrite=overwrite)

    def _to_tables(self) -> list[Table]:
        return [self._fold()]

    @classmethod
    def _sides(cls, columns: Columns, meta: Mapping[str, Any]) -> Sides:
        """Lengths that the shapes of the matrices name."""
        raise NotImplementedError

    @classmethod
    def _unfold(cls, path: str, table: Table) -> dict[str, NDArray[Any]]:
        """Check units and lengths; matrices to (..., j, i)."""
        require(path, table.colnames, cls.REQUIRED)
        columns: dict[str, NDArray[Any]] = {}
        for name in table.colnames:
            column, expected = table[name], cls.UNITS.get(name)
            given = getattr(column, "unit", None)
            if given is not None and expected is not None and given != units.Unit(expected):
                raise RecordingError(f"{path}: {name} is in {given}, not in {expected}")
            columns[name] = plain(np.asarray(column))
        if not len(table):
            return columns
        sides = cls._sides(columns, table.meta)
        for name, shape in cls.MATRICES.items():
            if name not in columns or not columns[name].size:
                continue
            rows = len(columns[name])
            lengths = [sides[one] for one in shape]
            if columns[name].size != rows * np.prod(lengths):
                raise RecordingError(
                    f"{path}: {name} has {columns[name].size // rows} numbers a row, not "
                    f"{' x '.join(str(n) for n in lengths)} ({', '.join(shape)})"
                )
            columns[name] = columns[name].reshape(rows, *lengths).swapaxes(-1, -2).copy()
        return columns

    def _fold(self) -> Table:
        """Put columns back as the pipelines have them."""
        table = Table()
        for name, array in self.columns.items():
            held = array
            if name in self.MATRICES and array.size:
                held = array.swapaxes(-1, -2)
                # The pipelines keep the filters' matrices as they are and flatten all others.
                if self.MATRICES[name][0] != "filters":
                    held = held.reshape(len(array), -1)
            table[name] = held
            if name in self.UNITS:
                table[name].unit = self.UNITS[name]
        table.meta = dict(self.meta)
        return table


def require(where: str, there: Any, names: tuple[str, ...]) -> None:
    """Raise unless all names are there."""
    lacking = [name for name in names if name not in there]
    if lacking:
        raise RecordingError(f"{where}: {', '.join(lacking)} missing")


def same(one: Columns, other: Columns) -> bool:
    """Whether both hold the same arrays, nan equal to nan."""
    if list(one) != list(other):
        return False
    return all(
        np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
        for name in one
    )


def look_up(meta: Mapping[str, Any], key: str, default: Any) -> Any:
    """Give a card whatever the case of its keyword: FITS changes that of short ones."""
    return next((v for k, v in meta.items() if k.lower() == key.lower()), default)


def plain(array: NDArray[Any]) -> NDArray[Any]:
    """Text as str, numbers in the machine's byte order."""
    if array.dtype.kind == "S":
        array = np.char.decode(array)
    return array.astype(array.dtype.newbyteorder("="))


def read_tables(path: str | os.PathLike[str]) -> list[Table]:
    """Read every table of a FITS file, or the one of an ECSV file.

    Raises
    ------
    RecordingError
        The file cannot be read or holds no table.
    """
    if Path(path).suffix == ".ecsv":
        return [_from_ecsv(path)]
    with open_fits(path) as hdus, warnings.catch_warnings():
        warnings.simplefilter("ignore", UnitsWarning)
        tables = [_from_hdu(hdu) for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
    if not tables:
        raise RecordingError(f"{path}: holds no table")
    return tables


def _from_ecsv(path: str | os.PathLike[str]) -> Table:
    """Read a table; numbers that are left out are nan, text is empty."""
    try:
        with warnings.catch_warnings():
            # Of types that are none astropy only warns.
            warnings.simplefilter("error", AstropyUserWarning)
            table = Table.read(path, format="ascii.ecsv")
    # Damaged headers end in several kinds of exception inside astropy.
    except (
        OSError, ValueError, TypeError, KeyError, AttributeError, AstropyUserWarning
    ) as error:  # fmt: skip
        line = " ".join(str(error).split())[:200]
        raise RecordingError(f"{path}: cannot be read: {line}") from None
    for name in table.colnames:
        if not np.any(getattr(table[name], "mask", False)):
            continue
        if table[name].dtype.kind not in "fU":
            raise RecordingError(f"{path}: column {name} has empty cells")
        table[name] = table[name].filled(np.nan if table[name].dtype.kind == "f" else "")
    return table


def write_tables(
    path: str | os.PathLike[str], tables: list[Table], *, overwrite: bool
) -> None:
    """Write tables beside and rename the file; ECSV where the name ends so.

    Raises
    ------
    RecordingError
        The file exists and ``overwrite`` is not set, or cannot hold this.
    """
    target = Path(path)
    refuse_existing(target, overwrite, RecordingError)
    if target.suffix == ".ecsv" and len(tables) > 1:
        raise RecordingError(f"{target}: ECSV holds one table, not {len(tables)}; use FITS")
    with written_whole(target, RecordingError) as beside:
        try:
            if target.suffix == ".ecsv":
                tables[0].write(beside, format="ascii.ecsv", overwrite=True)
                return
            with warnings.catch_warnings():
                # Keywords above eight letters become HIERARCH cards, as LSST's do.
                warnings.simplefilter("ignore", VerifyWarning)
                hdus = [fits.PrimaryHDU(), *(_to_hdu(table) for table in tables)]
                fits.HDUList(hdus).writeto(beside, overwrite=True)
        except ValueError as error:
            raise RecordingError(f"{target}: cannot be written: {error}") from None


def _to_hdu(table: Table) -> fits.BinTableHDU:
    plain = table.copy()
    meta, plain.meta = dict(plain.meta), {}
    # As in the pipelines' files, units are those of the format: FITS knows no electron, and
    # readers would warn of every column.  ECSV keeps them.
    for name in plain.colnames:
        plain[name].unit = None
    hdu = fits.table_to_hdu(plain)
    for key, value in meta.items():
        hdu.header[key] = value.item() if isinstance(value, np.generic) else value
    return hdu


_LAYOUT = re.compile(
    r"(XTENSION|BITPIX|NAXIS\d*|PCOUNT|GCOUNT|TFIELDS|CHECKSUM|DATASUM|COMMENT|HISTORY|"
    r"T(TYPE|FORM|UNIT|DIM|NULL|SCAL|ZERO|DISP)\d+|)"
)


def _from_hdu(hdu: fits.BinTableHDU) -> Table:
    """Take columns as they are: a nan is a value here, a column may have no width."""
    table = Table()
    for column in hdu.columns:
        empty = re.search(r"[(,]0[,)]", column.dim or "") is not None
        data = np.empty((len(hdu.data), 0)) if empty else np.array(hdu.data[column.name])
        table[column.name] = data
        if column.unit:
            table[column.name].unit = column.unit
    for card in hdu.header.cards:
        if not _LAYOUT.fullmatch(card.keyword):
            blank = isinstance(card.value, fits.card.Undefined)
            table.meta[card.keyword] = "" if blank else card.value
    return table
