"""Base class and reading and writing, FITS or ECSV, of LSST's calibration datasets."""

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
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.recording.raw.open_fits import open_fits
from bfsensor.text_files import UnreadableTextError, one_line, read_ecsv

Columns = Mapping[str, NDArray[Any]]
Sides = Mapping[str, int]
_Kind = TypeVar("_Kind", bound="CalibrationTable")


@dataclass(frozen=True, eq=False)
class CalibrationTable:
    """Columns of a calibration dataset, with matrices of lags as [j, i].

    Attributes
    ----------
    columns : mapping of str to ndarray
        Columns by the pipeline's names.  The first axis is the amplifier; matrices of lags have
        the shape (..., j, i).
    meta : mapping of str to value
        Values of the header by keyword; kind, schema and version of the dataset are filled in.
    """

    columns: Columns
    meta: Mapping[str, Any] = field(default_factory=dict)

    OBSTYPE: ClassVar[str] = ""
    SCHEMA: ClassVar[str] = ""
    VERSION: ClassVar[float] = 1.0
    REQUIRED: ClassVar[tuple[str, ...]] = ()
    MATRICES: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    UNITS: ClassVar[Mapping[str, str]] = {}
    POSITIVE: ClassVar[tuple[str, ...]] = ("GAIN",)

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
        """Version of the format that the header states."""
        return float(look_up(self.meta, f"{self.OBSTYPE}_VERSION", self.VERSION))

    @classmethod
    def read(cls: type[_Kind], path: str | os.PathLike[str]) -> _Kind:
        """Read the dataset from FITS, or from ECSV where the file's name ends in .ecsv.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        dataset : same class
            The dataset, with matrices of lags as [j, i].

        Raises
        ------
        RecordingError
            The file cannot be read, holds another kind of dataset, or a column is missing, in
            another unit or of another length.  The message names file and column.
        """
        tables = read_tables(path)
        kind = look_up(tables[0].meta, "OBSTYPE", None)
        if kind != cls.OBSTYPE:
            raise RecordingError(
                f"{path}: its OBSTYPE is {kind!r}, not {cls.OBSTYPE!r} as of {cls.__name__}"
            )
        try:
            made = cls._from_tables(str(path), tables)
        # Columns of another shape or type than the format's end in several kinds of exception.
        except (RecordingError, ValueError, TypeError, LookupError, OverflowError) as error:
            text = str(error) if isinstance(error, RecordingError) else one_line(error)
            place = "" if text.startswith(f"{path}: ") else f"{path}: "
            raise RecordingError(f"{place}{text}") from None
        for name in cls.POSITIVE:
            values = np.asarray(made.columns.get(name, ()), float)
            wrong = np.isinf(values) | (values <= 0)
            if wrong.any():
                raise RecordingError(
                    f"{path}: {name} = {values[wrong][0]:g} must be above 0 and finite (nan: not known)"
                )
        return made

    @classmethod
    def _from_tables(cls: type[_Kind], path: str, tables: list[Table]) -> _Kind:
        return cls(cls._unfold(path, tables[0]), tables[0].meta)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the dataset as FITS, or as ECSV where the file's name ends in .ecsv.

        The file is written under another name and then renamed, so that a partly written file
        never has its name.

        Parameters
        ----------
        path : path-like
            File to write.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        RecordingError
            The file exists and ``overwrite`` is False, or its format cannot hold the dataset.
        """
        write_tables(path, self._to_tables(), overwrite=overwrite)

    def _to_tables(self) -> list[Table]:
        return [self._fold()]

    @classmethod
    def _sides(cls, columns: Columns, meta: Mapping[str, Any]) -> Sides:
        """Lengths of the matrices' axes, by the words in ``MATRICES``."""
        raise NotImplementedError

    @classmethod
    def _unfold(cls, path: str, table: Table) -> dict[str, NDArray[Any]]:
        """Check units and lengths, and turn flattened matrices into arrays (..., j, i)."""
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
        """Table with the matrices flattened as the pipelines have them."""
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
    """Raise RecordingError unless a table has all these columns."""
    lacking = [name for name in names if name not in there]
    if lacking:
        given = ", ".join(map(str, there)) or "none"
        raise RecordingError(
            f"{where}: {', '.join(lacking)} missing; its columns are {given}"
        )


def same(one: Columns, other: Columns) -> bool:
    """Whether two mappings have the same arrays in the same order, nan equal to nan."""
    if list(one) != list(other):
        return False
    return all(
        np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
        for name in one
    )


def look_up(meta: Mapping[str, Any], key: str, default: Any) -> Any:
    """Value of a keyword in letters of either case: FITS turns short keywords into capitals."""
    return next((v for k, v in meta.items() if k.lower() == key.lower()), default)


def plain(array: NDArray[Any]) -> NDArray[Any]:
    """Array with text as str and with numbers in the machine's byte order."""
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
        raise RecordingError(f"{path}: holds no table, but images or headers only")
    return tables


def _from_ecsv(path: str | os.PathLike[str]) -> Table:
    """Read an ECSV table; empty cells of floats become nan, those of text ''."""
    try:
        table = read_ecsv(path)
    except UnreadableTextError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None
    for name in table.colnames:
        if not np.any(getattr(table[name], "mask", False)):
            continue
        if table[name].dtype.kind not in "fU":
            raise RecordingError(
                f"{path}: column {name} has empty cells, which its type "
                f"{table[name].dtype} does not allow"
            )
        table[name] = table[name].filled(np.nan if table[name].dtype.kind == "f" else "")
    return table


def write_tables(
    path: str | os.PathLike[str], tables: list[Table], *, overwrite: bool
) -> None:
    """Write tables as FITS, or one table as ECSV where the file's name ends in .ecsv.

    The file is written under another name and then renamed.

    Raises
    ------
    RecordingError
        The file exists and ``overwrite`` is False, or its format cannot hold the tables.
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
                # Keywords of more than eight letters become HIERARCH ones, as in LSST's files.
                warnings.simplefilter("ignore", VerifyWarning)
                hdus = [fits.PrimaryHDU(), *(_to_hdu(table) for table in tables)]
                fits.HDUList(hdus).writeto(beside, overwrite=True)
        except ValueError as error:
            raise RecordingError(f"{target}: cannot be written: {error}") from None


def _to_hdu(table: Table) -> fits.BinTableHDU:
    plain = table.copy()
    meta, plain.meta = dict(plain.meta), {}
    # The pipelines' FITS files have no units, and ours neither: the FITS standard has no unit
    # 'electron', and readers would warn of every column.  ECSV files keep the units.
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
"""Keywords of the FITS standard that describe a table's layout and are no part of ``meta``."""


def _from_hdu(hdu: fits.BinTableHDU) -> Table:
    """Table of an extension's columns, in which nan is a value and a column may have no width."""
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
