"""Sections of a raw FITS image: data, overscan, saturated pixels."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.typing import FloatArray

MAD_TO_SIGMA = 1.4826022185056018
"""Standard deviation of a Gaussian over its median absolute deviation."""

SATURATION_KEYS = ("SATURATE", "SATLEVEL")


def number_of(cards: Mapping[str, Any], keys: Sequence[str]) -> float:
    """Give the first of some cards that is a number; nan without one."""
    for key in keys:
        value = cards.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    return float("nan")


def end_of_range(header: fits.Header) -> float:
    """Largest signal [ADU] that the integers of a file can hold; nan for other numbers.

    Of the header as it is before astropy scales the data and changes it.
    """
    bits = int(header["BITPIX"])
    if bits < 0:
        return float("nan")
    ends = (0, 255) if bits == 8 else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    scale, zero = float(header.get("BSCALE", 1.0)), float(header.get("BZERO", 0.0))
    return max(scale * end + zero for end in ends) - 0.5 * abs(scale)


def find_saturated(
    data: NDArray[Any], cards: Mapping[str, Any], end: float
) -> NDArray[np.bool_]:
    """Find pixels at the header's saturation level, or at the end of an integer's range.

    A level of 0 or less, which some cameras write where they know none, is not one.
    """
    level = number_of(cards, SATURATION_KEYS)
    limit = np.fmin(level if level > 0 else np.nan, end)
    return np.asarray(data >= limit) if np.isfinite(limit) else np.zeros(data.shape, bool)


def parse_section(
    card: str, text: Any, where: str, shape: tuple[int, int]
) -> tuple[slice, slice]:
    """Read '[x1:x2,y1:y2]' as slices of rows and columns; None is the whole image."""
    if text is None:
        return slice(0, shape[0]), slice(0, shape[1])
    match = re.fullmatch(r"\s*\[\s*(\d+):(\d+)\s*,\s*(\d+):(\d+)\s*\]\s*", str(text))
    if match is None:
        raise RecordingError(f"{where}: {card} = {text!r} is not like '[1:512,1:2000]'")
    x1, x2, y1, y2 = (int(number) for number in match.groups())
    if x1 > x2 or y1 > y2:
        raise RecordingError(
            f"{where}: {card} = {text!r} runs backwards; flip the image and say so yourself"
        )
    if min(x1, y1) < 1 or x2 > shape[1] or y2 > shape[0]:
        raise RecordingError(
            f"{where}: {card} = {text!r} leaves the image, {shape[1]} x {shape[0]} pixels"
        )
    return slice(y1 - 1, y2), slice(x1 - 1, x2)


def subtract_overscan(
    where: str, pixels: FloatArray, area: tuple[slice, slice],
    strip: tuple[slice, slice] | None, method: str | None, skip: int,
) -> tuple[FloatArray, float, float, int]:  # fmt: skip
    """Data section less overscan; level and noise of it, pixels in a row of it.

    Overscan pixels that are not finite do not count.
    """
    image = pixels[area]
    if method is None:
        return image, float("nan"), float("nan"), 0
    if strip is None:
        raise RecordingError(
            f"{where}: BIASSEC is missing; give sections, or say overscan=None and a bias"
        )
    rows, columns = strip
    columns = slice(columns.start + skip, columns.stop)
    over = pixels[rows, columns]
    if over.shape[1] < 1:
        raise RecordingError(f"{where}: skip = {skip} leaves nothing of BIASSEC")
    good = np.isfinite(over)
    if not good.any():
        raise RecordingError(f"{where}: BIASSEC holds no finite number")
    mean, median = (np.mean, np.median) if good.all() else (np.nanmean, np.nanmedian)
    over = np.where(good, over, np.nan)
    with warnings.catch_warnings():
        # A row without a number has no level, and its pixels no value: they are masked.
        warnings.simplefilter("ignore", RuntimeWarning)
        by_row = median(over, axis=1, keepdims=True)
        means = mean(over, axis=1, keepdims=True)
    level = float(median(over))
    noise = MAD_TO_SIGMA * float(median(np.abs(over - by_row)))
    if method == "median":
        return image - level, level, noise, over.shape[1]
    if rows.start > area[0].start or rows.stop < area[0].stop:
        raise RecordingError(
            f"{where}: BIASSEC has the rows {rows.start + 1} to {rows.stop}, not all of "
            f"{area[0].start + 1} to {area[0].stop}; overscan='median' needs no rows"
        )
    if method == "row mean":
        by_row = means
    first = area[0].start - rows.start
    return image - by_row[first : first + len(image)], level, noise, over.shape[1]
