"""The overscan of an amplifier: where it is, its level, and images without it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.sections import AmplifierLayout, Box
from bfsensor.typing import FloatArray

OVERSCANS = ("row median", "row mean", "median")

SKIP = 2
"""Overscan columns next to the image that are left out: deferred charge comes out in them."""

MAD_TO_SIGMA = 1.4826022185056018
"""Standard deviation of a Gaussian over its median absolute deviation."""


def find_overscan(layout: AmplifierLayout, *, skip: int = SKIP) -> Box | None:
    """Find the pixels from which an amplifier's zero level is taken.

    Parameters
    ----------
    layout : AmplifierLayout
        As its header has it.
    skip : int
        Columns next to the image to leave out.

    Returns
    -------
    box : (slice, slice) or None
        Rows and columns in readout order: BIASSEC where the header names one, else the columns
        read after the image; of its rows those of the image, where it has any of them.  It may
        be without columns; None where there is no overscan, or a BIASSEC that cannot be used.

    Examples
    --------
    >>> from bfsensor.recording.raw.sections import layout_of
    >>> cards = {"DATASEC": "[1:32,1:20]", "BIASSEC": "[33:40,1:24]"}
    >>> find_overscan(layout_of("x", "A", 0, (24, 40), cards))
    (slice(0, 20, None), slice(34, 40, None))
    """
    if layout.bias_problem or (layout.bias is None and layout.serial_overscan < 1):
        return None
    image_rows, image = layout.data
    rows, columns = layout.bias or (image_rows, slice(image.stop, layout.raw_shape[1]))
    both = slice(max(rows.start, image_rows.start), min(rows.stop, image_rows.stop))
    if columns.start >= image.stop:
        first = min(max(columns.start, image.stop + skip), columns.stop)
        columns = slice(first, columns.stop)
    elif columns.stop <= image.start:
        last = max(min(columns.stop, image.start - skip), columns.start)
        columns = slice(columns.start, last)
    return (both if both.start < both.stop else rows), columns


def subtract_overscan(
    where: str,
    values: NDArray[Any],
    layout: AmplifierLayout,
    *,
    method: str | None = "row median",
    skip: int = SKIP,
) -> tuple[FloatArray, float, float, int]:
    """Give the data section less the overscan.

    Parameters
    ----------
    where : str
        Named in errors.
    values : ndarray, shape (ny, nx)
        All that the amplifier read [ADU], in readout order.
    layout : AmplifierLayout
        Where the sections are.
    method : {'row median', 'row mean', 'median', None}
        Each row's median or mean, the median of all, or nothing.
    skip : int
        Overscan columns next to the image to leave out.

    Returns
    -------
    image : ndarray, shape of the data section
        [ADU]; nan in rows whose overscan has no finite pixel.
    level, noise : float
        Median of the overscan, and its scatter about its rows' medians as of a Gaussian [ADU],
        too small by about one part in n for n pixels a row; nan without a method.
    count : int
        Overscan pixels of a row; those that are not finite do not count in the level.

    Raises
    ------
    RecordingError
        No overscan, none that is left or finite, or one that lacks rows that the method needs.
    """
    image = np.asarray(values[layout.data], float)
    if method is None:
        return image, float("nan"), float("nan"), 0
    box = find_overscan(layout, skip=skip)
    if box is None:
        what = layout.bias_problem or "no BIASSEC, and no columns after DATASEC"
        raise RecordingError(
            f"{where}: {what}; name the overscan in campaign.yaml (amplifiers: bias) or by "
            "`bfsensor measure --sections`, or choose the overscan 'none' to subtract nothing"
        )
    rows, columns = box
    over = np.asarray(values[rows, columns], float)
    if over.shape[1] < 1:
        raise RecordingError(f"{where}: skip = {skip} leaves nothing of the overscan")
    good = np.isfinite(over)
    if not good.any():
        raise RecordingError(f"{where}: the overscan holds no finite number")
    mean, median = (np.mean, np.median) if good.all() else (np.nanmean, np.nanmedian)
    over = np.where(good, over, np.nan)
    with warnings.catch_warnings():
        # A row without a number has no level, and its pixels no value: they are masked.
        warnings.simplefilter("ignore", RuntimeWarning)
        by_row = median(over, axis=1, keepdims=True)
        levels = mean(over, axis=1, keepdims=True) if method == "row mean" else by_row
    level = float(median(over))
    noise = MAD_TO_SIGMA * float(median(np.abs(over - by_row)))
    if method == "median":
        return image - level, level, noise, over.shape[1]
    wanted = layout.data[0]
    if rows != wanted:
        raise RecordingError(
            f"{where}: BIASSEC has the rows {rows.start + 1} to {rows.stop}, not all of "
            f"{wanted.start + 1} to {wanted.stop}; overscan='median' needs no rows"
        )
    return image - levels, level, noise, over.shape[1]


def mean_and_scatter(values: NDArray[Any]) -> tuple[float, float]:
    """Give mean and standard deviation of what lies within 5 sigma of the median.

    Medians of whole numbers would be whole numbers.
    """
    if not values.size:
        return float("nan"), float("nan")
    middle = float(np.median(values))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))
    kept = values[np.abs(values - middle) <= 5 * max(sigma, 0.5)].astype(np.float64)
    return float(kept.mean()), float(kept.std())
