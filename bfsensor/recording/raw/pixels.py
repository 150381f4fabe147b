"""Pixels of a raw file by amplifier, in readout order, with a mask of the bad ones."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import DTypeLike, NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.raw.open_fits import open_fits
from bfsensor.recording.raw.sections import AmplifierLayout


@dataclass(frozen=True, eq=False)
class AmplifierPixels:
    """Raw pixels of one amplifier in one exposure.

    Attributes
    ----------
    layout : AmplifierLayout
        Place of the amplifier in the file and on the sensor.
    values : ndarray, shape (ny, nx)
        All pixels [ADU], with prescan and overscan: axis 1 counts serial transfers from the
        output, axis 0 parallel ones.
    bad : ndarray of bool, shape (ny, nx)
        True where a pixel is not finite, saturated, or masked.
    saturation : float
        Level at and above which a pixel counts as saturated [ADU]; inf where none is known.
    """

    layout: AmplifierLayout
    values: NDArray[Any]
    bad: NDArray[np.bool_]
    saturation: float


def read_pixels(
    path: str | os.PathLike[str],
    layouts: Sequence[AmplifierLayout],
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
    *,
    dtype: DTypeLike = np.float32,
) -> tuple[AmplifierPixels, ...]:
    """Read the pixels of a file, amplifier by amplifier.

    Parameters
    ----------
    path : path-like
        The file.
    layouts : sequence of AmplifierLayout
        Layouts of its amplifiers, as :func:`bfsensor.recording.raw.headers.scan_file` finds
        them.
    masks : mapping of str to ndarray of bool, optional
        Pixels of the data section to leave out, by amplifier, in readout order.
    dtype : dtype
        Type of the values; single precision holds every number of a 16 bit converter exactly.

    Returns
    -------
    pixels : tuple of AmplifierPixels
        One for each amplifier, in the order of ``layouts``.

    Raises
    ------
    RecordingError
        The file cannot be read, or its images are not of the shapes that ``layouts`` have.

    Notes
    -----
    A pixel is saturated where it reaches the saturation of header or campaign.yaml, or the
    largest number that the integers of the file can hold.
    """
    found = []
    stored: NDArray[Any] | None = None
    opened, end = -1, np.inf
    with open_fits(path) as hdus:
        for layout in layouts:
            if layout.hdu != opened:
                if opened >= 0:
                    del hdus[opened].data  # several amplifiers may share an image
                opened = layout.hdu
                end = end_of_range(hdus[opened].header)  # astropy changes it with the data
                stored = np.asarray(hdus[opened].data)
            if stored is None or stored.shape != layout.stored:
                shape = None if stored is None else stored.shape
                raise RecordingError(
                    f"{path}: {layout.name} has the shape (ny, nx) = {shape}, not "
                    f"{layout.stored} as in its header or in the other files"
                )
            mask = None if masks is None else masks.get(layout.name)
            found.append(_cut(layout, stored, end, mask, dtype))
    return tuple(found)


def end_of_range(header: fits.Header) -> float:
    """Give the largest signal [ADU] that the integers of an image can hold; inf for floats.

    Parameters
    ----------
    header : Header
        Header as stored: astropy removes BSCALE and BZERO from it when it scales the data.

    Examples
    --------
    >>> end_of_range(fits.Header({"BITPIX": 16, "BZERO": 32768}))
    65535.0
    """
    bits = int(header["BITPIX"])
    if bits < 0:
        return float("inf")
    ends = (0, 255) if bits == 8 else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    scale, zero = float(header.get("BSCALE", 1.0)), float(header.get("BZERO", 0.0))
    largest = max(scale * end + zero for end in ends)
    # Scaled integers become floats with rounding errors: half a step below the last integer's
    # value, the last one still counts as saturated and the one before does not.
    return largest if scale == 1.0 else largest - 0.5 * abs(scale)


def _cut(
    layout: AmplifierLayout, stored: NDArray[Any], end: float,
    mask: NDArray[np.bool_] | None, dtype: DTypeLike,
) -> AmplifierPixels:  # fmt: skip
    """Cut one amplifier out of a stored image, in readout order."""
    values = stored[layout.window]
    values = values[
        :: -1 if layout.stored_flip_y else 1, :: -1 if layout.stored_flip_x else 1
    ]
    limit = end if layout.saturation is None else min(layout.saturation, end)
    # A value beyond single precision becomes infinite, and is masked below.
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(values, dtype)
    bad = np.zeros(values.shape, bool)
    if np.isfinite(limit):
        np.greater_equal(values, limit, out=bad)
    if values.dtype.kind == "f":
        bad |= ~np.isfinite(values)
    if mask is not None:
        bad[layout.data] |= mask
    return AmplifierPixels(layout, values, bad, limit)
