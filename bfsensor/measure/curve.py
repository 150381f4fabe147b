"""Covariance curves: covariances of many pairs of flats of one region against level."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.ecsv import read_ecsv, same_fields, write_ecsv
from bfsensor.measure.flat_pairs import UNITS, FlatCovariances, flat_covariances
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor covariance curve"


@dataclass(frozen=True, eq=False)
class CovarianceCurve:
    """C_ij against the level, a row for each pair of flats, sorted by level.

    Attributes
    ----------
    levels : ndarray, shape (n,)
        Mean level of each pair [unit].
    covariances, errors : ndarray, shape (n, lags + 1, lags + 1)
        ``covariances[k, j, i]``: C_ij of pair k and its error [unit^2].
    pairs : ndarray of int, shape (n, lags + 1, lags + 1)
        Number of pairs of pixels at each lag (i, j), without those of (i, -j).
    unit : str
        'electron' or 'adu'.
    region : str
        Name of the amplifier or region.

    Examples
    --------
    >>> rng = np.random.default_rng(8233)
    >>> flats = [rng.poisson(mu, size=(2, 100, 100)) for mu in (5e3, 1e4)]
    >>> curve = measure_curve(flats, lags=2)
    >>> curve.levels.round(-3)
    array([ 5000., 10000.])
    """

    levels: FloatArray
    covariances: FloatArray
    errors: FloatArray
    pairs: NDArray[np.int64]
    unit: str = "electron"
    region: str = ""

    def __post_init__(self) -> None:
        levels = np.array(self.levels, float)
        if levels.ndim != 1 or not len(levels) or not np.all(np.isfinite(levels)):
            raise MeasurementError("levels must be a list of finite numbers, not empty")
        order = np.argsort(levels, kind="stable")
        object.__setattr__(self, "levels", levels[order])
        for name, kind in (("covariances", float), ("errors", float), ("pairs", np.int64)):
            array = np.array(getattr(self, name), dtype=kind)
            if (
                array.ndim != 3
                or array.shape != np.shape(self.covariances)
                or len(array) != len(levels)
                or array.shape[1] != array.shape[2]
            ):
                raise MeasurementError(
                    f"{name} of shape {array.shape} must be (n, lags + 1, lags + 1) for "
                    f"{len(levels)} levels"
                )
            object.__setattr__(self, name, array[order])
        if not np.all(np.isfinite(self.covariances)):
            raise MeasurementError("covariances must be finite; leave bad pairs out")
        if not np.all(self.errors > 0):
            raise MeasurementError("errors must be above 0")
        if self.unit not in UNITS:
            raise MeasurementError(f"unit = {self.unit!r} is not one of {', '.join(UNITS)}")
        for name in ("levels", "covariances", "errors", "pairs"):
            getattr(self, name).setflags(write=False)

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def lags(self) -> int:
        """Largest lag in x and in y [pixel]."""
        return self.covariances.shape[-1] - 1

    @classmethod
    def from_pairs(cls, pairs: Iterable[FlatCovariances]) -> CovarianceCurve:
        """Make a curve of measured pairs of one region.

        Parameters
        ----------
        pairs : iterable of FlatCovariances
            Pairs with the same lags, unit and region.

        Returns
        -------
        curve : CovarianceCurve
            The pairs, sorted by level.

        Raises
        ------
        MeasurementError
            There is no pair, or pairs differ in lags, unit or region.
        """
        found = list(pairs)
        if not found:
            raise MeasurementError("no pair of flats was given")
        for name in ("lags", "unit", "region"):
            values = {getattr(one, name) for one in found}
            if len(values) > 1:
                raise MeasurementError(
                    f"pairs differ in {name}: {sorted(values)}; a curve is of one {name}"
                )
        return cls(
            levels=np.array([one.level for one in found]),
            covariances=np.array([one.covariances for one in found]),
            errors=np.array([one.errors for one in found]),
            pairs=np.array([one.pairs for one in found]),
            unit=found[0].unit,
            region=found[0].region,
        )

    @classmethod
    def from_arrays(
        cls,
        levels: ArrayLike,
        covariances: ArrayLike,
        *,
        pixels: int,
        unit: str = "electron",
        region: str = "",
    ) -> CovarianceCurve:
        """Make a curve from covariances measured elsewhere, with Bartlett's errors.

        Parameters
        ----------
        levels : array_like, shape (n,)
            Mean levels [unit].
        covariances : array_like, shape (n, lags + 1, lags + 1)
            C_ij of one flat [unit^2], indexed [pair, j, i].
        pixels : int
            Number of pixels of each measurement, 1 or more.
        unit : {'electron', 'adu'}
            Unit of the levels.
        region : str
            Name of the amplifier or region.

        Returns
        -------
        curve : CovarianceCurve
            The covariances, sorted by level.

        Raises
        ------
        MeasurementError
            Shapes do not match, or ``pixels`` is below 1.
        """
        c = np.asarray(covariances, float)
        if c.ndim != 3 or c.shape[1] != c.shape[2]:
            raise MeasurementError(f"covariances of shape {c.shape} are not (n, j, i)")
        if not pixels >= 1:
            raise MeasurementError(f"pixels = {pixels} must be at least 1")
        pairs = np.full(c.shape, int(pixels))
        variance = np.diagonal(bartlett_matrix(c, pairs), axis1=1, axis2=2)
        errors = np.sqrt(variance).reshape(c.shape)
        return cls(np.asarray(levels), c, errors, pairs, unit, region)

    def select(
        self, keep: ArrayLike | None = None, *, lags: int | None = None
    ) -> CovarianceCurve:
        """Return a curve of some pairs and lags.

        Parameters
        ----------
        keep : array_like of bool or int, optional
            Mask of the pairs, shape (n,), or their indices; by default all.
        lags : int, optional
            Largest lag to keep, by default that of the curve.

        Returns
        -------
        curve : CovarianceCurve
            A copy of the selected pairs.

        Raises
        ------
        MeasurementError
            The mask has another length, or ``lags`` is out of range.
        """
        at = np.arange(len(self)) if keep is None else np.asarray(keep)
        if lags is not None and not 0 <= lags <= self.lags:
            raise MeasurementError(
                f"lags = {lags} must be from 0 to {self.lags}, the curve's"
            )
        if at.dtype == bool and at.shape != (len(self),):
            raise MeasurementError(
                f"a choice of shape {at.shape} for {len(self)} pairs must be ({len(self)},)"
            )
        side = (self.lags if lags is None else lags) + 1
        return CovarianceCurve(
            self.levels[at], self.covariances[at, :side, :side],
            self.errors[at, :side, :side], self.pairs[at, :side, :side],
            self.unit, self.region,
        )  # fmt: skip

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the curve as ECSV, a row for each pair, lags as [j, i].

        Parameters
        ----------
        path : path-like
            File to write, under another name first and then renamed.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        MeasurementError
            The file exists and ``overwrite`` is False, or it cannot be written.
        """
        text = "[j, i], i the lag in x, j in y"
        columns: dict[str, tuple[Any, str | None, str]] = {
            "level": (self.levels, self.unit, "mean level"),
            "covariances": (self.covariances, f"{self.unit}2", f"C_ij, {text}"),
            "errors": (self.errors, f"{self.unit}2", f"1 sigma after Bartlett, {text}"),
            "pairs": (self.pairs, None, f"pairs of pixels, {text}"),
        }
        meta = {"unit": self.unit, "region": self.region}
        write_ecsv(path, SCHEMA, columns, meta, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> CovarianceCurve:
        """Read a file that :meth:`write` made.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        curve : CovarianceCurve
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another kind, or lacks a column.
        """
        names = ("level", "covariances", "errors", "pairs")
        columns, meta = read_ecsv(path, SCHEMA, names, ("unit", "region"))
        return cls(levels=columns.pop("level"), **columns, **meta)


def measure_curve(
    pairs: Iterable[Sequence[ArrayLike]] | NDArray[Any], **options: Any
) -> CovarianceCurve:
    """Measure the covariances of many pairs of flats of one region.

    Parameters
    ----------
    pairs : iterable of (first, second)
        Pairs of flats as :func:`~bfsensor.measure.flat_pairs.flat_covariances` takes them.
        They are read one by one, so that a generator needs the memory of one pair.
    **options
        Keyword arguments of :func:`~bfsensor.measure.flat_pairs.flat_covariances`.

    Returns
    -------
    curve : CovarianceCurve
        Covariances of the pairs, sorted by level.

    Raises
    ------
    MeasurementError
        There is no pair, or one cannot be measured; the message has its index from 0.

    Examples
    --------
    >>> rng = np.random.default_rng(8233)
    >>> flats = (rng.poisson(mu, size=(2, 100, 100)) for mu in (1e4, 5e3))
    >>> curve = measure_curve(flats, lags=1)
    >>> curve.levels.round(-3).tolist(), curve.covariances.shape
    ([5000.0, 10000.0], (2, 2, 2))
    """
    found = []
    for number, pair in enumerate(pairs):
        if len(pair) != 2:
            raise MeasurementError(f"pair {number} holds {len(pair)} flats, not 2")
        try:
            found.append(flat_covariances(pair[0], pair[1], **options))
        except MeasurementError as error:
            raise MeasurementError(f"pair {number}: {error}") from None
    return CovarianceCurve.from_pairs(found)
