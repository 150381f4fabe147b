"""Search for spots on an image, and postage stamps of them.

:func:`find_spots` gives the brightest pixels, :func:`cut_stamps` the stamps,
:func:`bfsensor.measure.spot_fit.fit_spots` the sizes, and
:func:`bfsensor.measure.slopes.bf_slopes` the brighter-fatter slope of sizes at several fluxes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.typing import FloatArray

STAMP = 9
"""Side of a stamp [pixel], as in Lage et al. (2017), section 2.1: 4 sigma of their spots."""


@dataclass(frozen=True, eq=False)
class SpotList:
    """Brightest pixels of spots, and the numbers of rejected candidates by reason.

    Parameters
    ----------
    x, y : ndarray of int, shape (n,)
        Column and row of the brightest pixel of each spot, from 0.
    rejected : mapping of str to int
        Numbers of rejected candidates by the first reason that holds, in this order:
        ``neighbour`` (a brighter one is too near), ``border`` (the stamp leaves the image),
        ``saturated``, ``masked``.

    Examples
    --------
    >>> spots = SpotList(np.array([20, 31]), np.array([10, 12]), {"border": 1})
    >>> len(spots), spots.rejected["border"]
    (2, 1)
    """

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    rejected: Mapping[str, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "rejected", MappingProxyType(dict(self.rejected)))

    def __len__(self) -> int:
        return len(self.x)

    def __reduce__(self) -> tuple[Any, ...]:
        return SpotList, (self.x, self.y, dict(self.rejected))


@dataclass(frozen=True, eq=False)
class Stamps:
    """Postage stamps of spots, each with its brightest pixel in the middle.

    Parameters
    ----------
    electrons : ndarray, shape (n, ny, nx)
        Signals [e-]; ny and nx odd, 3 or more.
    good : ndarray of bool, shape (n, ny, nx), optional
        True for pixels to use, by default all.  Values that are not finite are never used.
    variance : ndarray, shape (n, ny, nx), optional
        Known variance of each pixel [e-^2], above 0; by default a fit takes that of its model.
    x, y : ndarray of int, shape (n,), optional
        Column and row of the central pixels on the image, by default 0.

    Raises
    ------
    MeasurementError
        Shapes do not match, sides are even, or a variance is not above 0.

    Examples
    --------
    >>> stamps = Stamps(np.ones((3, 9, 9)))
    >>> len(stamps), bool(stamps.good.all())
    (3, True)
    """

    electrons: FloatArray
    good: NDArray[np.bool_] | Any = None
    variance: FloatArray | None = None
    x: NDArray[np.int64] | Any = None
    y: NDArray[np.int64] | Any = None

    def __post_init__(self) -> None:
        electrons = to_floats(self.electrons, "stamps")
        if electrons.ndim != 3 or len(electrons) == 0:
            raise MeasurementError(
                f"stamps of shape {electrons.shape} must be (spots, rows, columns), with one spot "
                "at least"
            )
        ny, nx = electrons.shape[1:]
        if ny % 2 == 0 or nx % 2 == 0 or min(ny, nx) < 3:
            raise MeasurementError(f"{ny} x {nx} pixels of a stamp must be odd, 3 or more")
        good = np.isfinite(electrons)
        if self.good is not None:
            good &= _fitting("good", np.asarray(self.good, bool), electrons.shape)
        if self.variance is not None:
            variance = _fitting("variance", np.array(self.variance, float), electrons.shape)
            if not np.all(variance[good] > 0):
                raise MeasurementError("variance of used pixels must be above 0 e-^2")
            # Unused pixels need a finite variance above 0, whose value does not matter.
            object.__setattr__(self, "variance", np.where(good, variance, 1.0))
        object.__setattr__(self, "electrons", np.where(good, electrons, 0.0))
        object.__setattr__(self, "good", good)
        for name in ("x", "y"):
            given = getattr(self, name)
            place = np.zeros(len(electrons)) if given is None else np.asarray(given)
            place = _fitting(name, place, (len(electrons),)).astype(np.int64)
            object.__setattr__(self, name, place)

    def __len__(self) -> int:
        return len(self.electrons)

    def select(self, which: NDArray[Any]) -> Stamps:
        """Return some of the stamps.

        Parameters
        ----------
        which : ndarray of bool or int
            Mask of the stamps, shape (n,), or their indices.

        Returns
        -------
        stamps : Stamps
            The selected stamps.
        """
        variance = None if self.variance is None else self.variance[which]
        return Stamps(
            self.electrons[which], self.good[which], variance, self.x[which], self.y[which]
        )


def _fitting(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array after a check of its shape."""
    if array.shape != shape:
        raise MeasurementError(f"{name} has the shape {array.shape}, not {shape}")
    return array


def find_spots(
    image: ArrayLike,
    *,
    threshold: float,
    separation: int = STAMP,
    saturation: float = np.inf,
    mask: ArrayLike | None = None,
    stamp: int = STAMP,
) -> SpotList:
    """Find the brightest pixels of spots.

    A candidate is a pixel above the threshold that none of the eight around it exceeds (of equal
    ones the first in reading order).  Only the pixel is found; :func:`fit_spots` finds the centre.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Signals [e-].
    threshold : float
        Signal that the brightest pixel must exceed, background included [e-].
    separation : int
        Smallest distance of two spots [pixel], 2 or more: of two candidates that are closer
        both in x and in y the fainter is rejected.  By default stamps of kept spots do not
        contain one another's centres.  The brighter one stays, and the fit decides whether
        it is disturbed.
    saturation : float
        Signal [e-] at or above which a pixel of the stamp makes a spot rejected.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad; pixels that are not finite, or hidden in a masked array, are
        bad too.  A spot with a bad pixel in the 3 x 3 around its brightest pixel is rejected;
        elsewhere the fit leaves bad pixels out.
    stamp : int
        Side of the stamps [pixel], odd; spots whose stamp leaves the image are rejected.

    Returns
    -------
    spots : SpotList
        Spots in reading order, and numbers of rejected candidates by reason.

    Raises
    ------
    MeasurementError
        An argument is out of range.

    Examples
    --------
    >>> from bfsensor.measure.spot_model import Shape, integrate_gaussian
    >>> image = np.zeros((40, 40))
    >>> image[6:15, 16:25] = 1e5 * integrate_gaussian([0.1], [0.2], Shape(1.0, 1.0), 9)[0]
    >>> image[0, 3] = 9e4
    >>> spots = find_spots(image, threshold=1000.0)
    >>> spots.x.tolist(), spots.y.tolist(), spots.rejected["border"]
    ([20], [10], 1)
    """
    data = to_floats(image, "image")
    _check_search(data, threshold, separation, saturation, stamp)
    bad = ~np.isfinite(data)
    if mask is not None:
        bad |= _fitting("mask", np.asarray(mask, bool), data.shape)
    clean = np.where(bad, -np.inf, data)
    y, x = find_peaks(clean, threshold, 3)
    # Brightest first, of equal ones the first in reading order.
    order = np.argsort(-clean[y, x], kind="stable")
    y, x = y[order], x[order]
    alone = _leave_brighter(x, y, separation, data.shape)
    half = stamp // 2
    ny, nx = data.shape
    inside = (x >= half) & (x < nx - half) & (y >= half) & (y < ny - half)
    spoilt = largest_around(bad, y, x, 3)
    highest = largest_around(clean, y, x, stamp)
    reasons = {
        "neighbour": ~alone,
        "border": ~inside,
        "saturated": highest >= saturation,
        "masked": spoilt,
    }
    kept = np.ones(len(x), bool)
    rejected = {}
    for reason, holds in reasons.items():
        rejected[reason] = int(np.sum(kept & holds))
        kept &= ~holds
    x, y = x[kept], y[kept]
    order = np.lexsort((x, y))
    return SpotList(x[order].astype(np.int64), y[order].astype(np.int64), rejected)


def find_peaks(
    image: NDArray[Any], threshold: float, size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find pixels above a threshold that no pixel near them exceeds.

    Only the pixels above the threshold are compared with those around them: in an image of spots
    these are few, and a filter of the whole image takes ten times as long.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Signals, without nan.
    threshold : float
        Value that a peak must exceed.
    size : int
        Side of the square around a pixel in which none may exceed it [pixel], odd.

    Returns
    -------
    y, x : ndarray of int, shape (n,)
        Rows and columns of the peaks, in reading order.

    Examples
    --------
    >>> image = np.zeros((5, 5))
    >>> image[1, 2], image[2, 3], image[4, 0] = 9.0, 8.0, 7.0
    >>> [at.tolist() for at in find_peaks(image, 1.0, 3)]
    [[1, 4], [2, 0]]
    """
    y, x = np.nonzero(image > threshold)
    # Most pixels of a spot are below one of their nearest neighbours: few are left for the rest.
    for side in sorted({min(3, size), size}):
        top = image[y, x] == largest_around(image, y, x, side)
        y, x = y[top], x[top]
    return y, x


def largest_around(
    image: NDArray[Any], y: NDArray[np.int64], x: NDArray[np.int64], size: int
) -> NDArray[Any]:
    """Largest values of an image in squares around pixels, as far as these lie inside.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Values, without nan.
    y, x : ndarray of int, shape (n,)
        Rows and columns of the pixels.
    size : int
        Side of the squares [pixel], odd.

    Returns
    -------
    largest : ndarray, shape (n,)

    Examples
    --------
    >>> largest_around(np.arange(12).reshape(3, 4), np.array([0, 2]), np.array([0, 1]), 3)
    array([ 5, 10])
    """
    steps = np.arange(size) - size // 2
    out = image[y, x]
    for dy in steps:
        row = np.clip(y + dy, 0, image.shape[0] - 1)
        for dx in steps:
            np.maximum(out, image[row, np.clip(x + dx, 0, image.shape[1] - 1)], out=out)
    return out


def _check_search(
    data: FloatArray,
    threshold: float,
    separation: int,
    saturation: float,
    stamp: int,
) -> None:
    if data.ndim != 2:
        raise MeasurementError(f"an image has rows and columns, not the shape {data.shape}")
    if not np.isfinite(threshold):
        raise MeasurementError(f"threshold = {threshold} e- must be finite")
    if not saturation > threshold:
        raise MeasurementError(
            f"saturation = {saturation:g} e- must be above the threshold, {threshold:g} e-"
        )
    if stamp < 3 or stamp % 2 == 0:
        raise MeasurementError(f"stamp = {stamp} pixels must be odd, 3 or more")
    if separation < 2:
        raise MeasurementError(f"separation = {separation} pixels must be 2 or more")
    if int(separation) != separation:
        raise MeasurementError(
            f"separation = {separation} must be a whole number of pixels"
        )
    if min(data.shape) < stamp:
        raise MeasurementError(
            f"an image of {data.shape} pixels is smaller than a stamp of {stamp} x {stamp}"
        )


def _leave_brighter(
    x: NDArray[Any], y: NDArray[Any], separation: int, shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Mask of the candidates, brightest first, that have no brighter kept one too near."""
    taken = np.zeros(shape, bool)
    alone = np.zeros(len(x), bool)
    for n, (i, j) in enumerate(zip(x, y, strict=True)):
        if not taken[j, i]:
            alone[n] = True
            low_j, low_i = max(j - separation + 1, 0), max(i - separation + 1, 0)
            taken[low_j : j + separation, low_i : i + separation] = True
    return alone


def cut_stamps(
    image: ArrayLike,
    spots: SpotList,
    *,
    size: int = STAMP,
    mask: ArrayLike | None = None,
    variance: ArrayLike | None = None,
) -> Stamps:
    """Cut the postage stamps of spots out of an image.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Signals [e-].
    spots : SpotList
        Spots from :func:`find_spots`, with the same or a larger stamp.
    size : int
        Side of the stamps [pixel], odd, 3 or more.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad.
    variance : array_like, shape (ny, nx), optional
        Known variance of each pixel [e-^2].

    Returns
    -------
    stamps : Stamps
        Stamps in the order of the spots.

    Raises
    ------
    MeasurementError
        There are no spots, a stamp leaves the image, or shapes do not match.

    Examples
    --------
    >>> image = np.zeros((40, 40))
    >>> image[12, 20] = 1e5
    >>> stamps = cut_stamps(image, find_spots(image, threshold=1e3), size=7)
    >>> stamps.electrons.shape, stamps.x.tolist(), float(stamps.electrons[0, 3, 3])
    ((1, 7, 7), [20], 100000.0)
    """
    data = to_floats(image, "image")
    if data.ndim != 2:
        raise MeasurementError(f"an image has rows and columns, not the shape {data.shape}")
    if len(spots) == 0:
        raise MeasurementError(
            f"no spots to cut out; rejected candidates by reason: {dict(spots.rejected)}"
        )
    if size < 3 or size % 2 == 0:
        raise MeasurementError(f"size = {size} pixels of a stamp must be odd, 3 or more")
    step = np.arange(size) - size // 2
    rows, columns = spots.y[:, None, None] + step[:, None], spots.x[:, None, None] + step
    ny, nx = data.shape
    if rows.min() < 0 or columns.min() < 0 or rows.max() >= ny or columns.max() >= nx:
        raise MeasurementError(
            f"stamps of {size} x {size} pixels leave the image of {ny} x {nx}: find spots with "
            f"stamp={size}"
        )
    at = (rows, columns)
    return Stamps(
        data[at],
        None if mask is None else ~_fitting("mask", np.asarray(mask, bool), data.shape)[at],
        None
        if variance is None
        else _fitting("variance", np.asarray(variance, float), data.shape)[at],
        spots.x,
        spots.y,
    )
