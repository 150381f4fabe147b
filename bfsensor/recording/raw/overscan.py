"""Overscan of an amplifier: its place, its level, and its subtraction from the image."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.sections import AmplifierLayout, Box
from bfsensor.typing import FloatArray

OVERSCANS = ("row median", "row mean", "median")
"""Methods by which the level of the overscan is found; see :func:`subtract_overscan`."""

SKIP = 2
"""Number of overscan columns next to the image that are left out.

Charge deferred from the image's last pixels appears in them and would raise the level.  Chosen:
with twice as many, two more columns do not count in a row's level, whose variance rises by 2 / n
of itself for n columns, and an overscan of 3 or 4 columns cannot be used.
"""

MAD_TO_SIGMA = 1.4826022185056018
"""Standard deviation of a Gaussian over its median absolute deviation.

Derived: 1 / z, where z = 0.6745 is the normal distribution's quantile of 3 / 4.
"""


def find_overscan(layout: AmplifierLayout, *, skip: int = SKIP) -> Box | None:
    """Find the pixels from which an amplifier's zero level is taken.

    Parameters
    ----------
    layout : AmplifierLayout
        Layout with the sections of the header or of campaign.yaml.
    skip : int
        Number of columns next to the image to leave out.

    Returns
    -------
    box : (slice, slice) or None
        Rows and columns in readout order: BIASSEC where the header names one, else the columns
        read after the image; only the rows that are also the image's, where there are any.  The
        columns may be empty, where ``skip`` leaves none.  None where there is no overscan, or a
        BIASSEC that cannot be used.

    Examples
    --------
    >>> from bfsensor.recording.raw.sections import layout_of
    >>> sections = {"DATASEC": "[1:32,1:20]", "BIASSEC": "[33:40,1:24]"}
    >>> find_overscan(layout_of("x", "A", 0, (24, 40), sections))
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
    """Cut the data section out of an amplifier's pixels and subtract the overscan's level.

    Parameters
    ----------
    where : str
        Name of file and amplifier, for errors.
    values : ndarray, shape (ny, nx)
        All pixels of the amplifier [ADU], in readout order.
    layout : AmplifierLayout
        Places of the sections.
    method : {'row median', 'row mean', 'median', None}
        Level to subtract: each row's median or mean over the overscan, the median of all of it,
        or none.
    skip : int
        Number of overscan columns next to the image to leave out.

    Returns
    -------
    image : ndarray, shape of the data section
        Image less the level [ADU]; nan in rows whose overscan has no finite pixel, where a row's
        level is subtracted.
    level : float
        Median of the overscan [ADU]; nan without a method.
    noise : float
        Scatter of the overscan about the medians of its rows [ADU], 1.4826 times the median
        absolute deviation; too small by about one part in n for n pixels a row; nan without
        a method.
    count : int
        Number of overscan pixels of a row, also of those that are not finite and do not count
        in the level.

    Raises
    ------
    RecordingError
        There is no overscan, ``skip`` leaves none, no pixel of it is finite, or it lacks rows
        of the image and the method subtracts row by row.
    """
    image = np.asarray(values[layout.data], float)
    if method is None:
        return image, float("nan"), float("nan"), 0
    box = find_overscan(layout, skip=skip)
    if box is None:
        what = layout.bias_problem or "no BIASSEC, and no columns after DATASEC"
        raise RecordingError(
            f"{where}: {what}; state the overscan in campaign.yaml (amplifiers: bias) or with "
            "`bfsensor measure --sections`, or subtract nothing: `--overscan none`, in Python "
            "overscan=None"
        )
    rows, columns = box
    over = np.asarray(values[rows, columns], float)
    if over.shape[1] < 1:
        raise RecordingError(
            f"{where}: skip = {skip} leaves no column of the overscan; choose a smaller skip"
        )
    good = np.isfinite(over)
    if not good.any():
        raise RecordingError(f"{where}: the overscan holds no finite number")
    mean, median = (np.mean, np.median) if good.all() else (np.nanmean, np.nanmedian)
    over = np.where(good, over, np.nan)
    with warnings.catch_warnings():
        # The level of a row without a finite overscan pixel is nan, and so are its pixels: the
        # caller masks them.  numpy warns of such rows.
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
            f"{wanted.start + 1} to {wanted.stop}, which the image has; the overscan 'median' "
            "subtracts one level from all rows and needs none in particular"
        )
    return image - levels, level, noise, over.shape[1]


def mean_and_scatter(values: NDArray[Any]) -> tuple[float, float]:
    """Mean and standard deviation of the values within 5 sigma of the median.

    The mean resolves fractions of an ADU, which the median of whole numbers cannot.  The cut is
    at least 2.5 ADU wide on each side, because the median deviation of quiet whole numbers is 0.
    """
    if not values.size:
        return float("nan"), float("nan")
    middle = float(np.median(values))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))
    kept = values[np.abs(values - middle) <= 5 * max(sigma, 0.5)].astype(np.float64)
    return float(kept.mean()), float(kept.std())
