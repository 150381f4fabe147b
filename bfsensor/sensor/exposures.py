"""Correction of exposure objects of LSST's pipelines in place, without an import of these pipelines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import SensorError, SensorTypeError
from bfsensor.sensor.corrected_files import PLANES
from bfsensor.sensor.table_correction import correct_table
from bfsensor.table.table import DistortionTable


def correct_exposure(
    exposure: Any,
    table: DistortionTable | str,
    *,
    gains: float | str | Mapping[str, float] = 1.0,
    planes: Sequence[str] = PLANES,
    **options: Any,
) -> None:
    """Take the brighter-fatter effect out of an exposure, in place.

    Parameters
    ----------
    exposure : lsst.afw.image.Exposure or alike
        Object with ``image.array``, and ``mask`` with ``array``, ``getMaskPlaneDict()`` if it has one;
        with ``gains`` by amplifier also ``getDetector()``, whose amplifiers have ``getName()``,
        ``getGain()`` and ``getBBox()``.
    table : DistortionTable or str
        As of :func:`bfsensor.correct_table`.
    gains : float, 'detector' or mapping of str to float
        Gain of all pixels [e-/ADU], 1 for images in electrons; those of the detector's amplifiers;
        or gains by the amplifiers' names.
    planes : sequence of str
        Names of the mask planes whose pixels light did not fill; those that the mask lacks are left out.
    **options
        Further arguments of :func:`bfsensor.correct_table`, but for ``mask`` and ``out``.

    Raises
    ------
    SensorTypeError
        The object has no image with an array.
    SensorError
        Gains are asked of an exposure without a detector, or a gain is missing or not above 0; or as
        raised by :func:`bfsensor.correct_table`.

    Notes
    -----
    The variance plane stays: that of light is the same as in a recorded image.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> star = 9e4 * np.exp(-0.5 * np.hypot(*np.indices((41, 41)) - 20) ** 2 / 1.5**2)
    >>> exposure = SimpleNamespace(image=SimpleNamespace(array=star.copy()))
    >>> correct_exposure(exposure, "itl_sta3800c")
    >>> bool(exposure.image.array[20, 20] > star[20, 20])
    True
    """
    array = getattr(getattr(exposure, "image", None), "array", None)
    if not isinstance(array, np.ndarray):
        raise SensorTypeError(
            f"an exposure needs image.array, which {type(exposure).__name__} lacks"
        )
    mask = _masked(exposure, planes, array.shape)
    gain = _gains(exposure, gains, array.shape)
    corrected = correct_table(np.asarray(array, float) * gain, table, mask=mask, **options)
    array[...] = corrected / gain


def _masked(
    exposure: Any, planes: Sequence[str], shape: tuple[int, ...]
) -> NDArray[np.bool_] | None:
    """Pixels with one of the planes; None for an exposure without a mask."""
    mask = getattr(exposure, "mask", None)
    if mask is None:
        return None
    known = mask.getMaskPlaneDict()
    bits = sum(1 << int(known[name]) for name in planes if name in known)
    return np.asarray((np.asarray(mask.array) & bits) != 0).reshape(shape)


def _gains(
    exposure: Any, gains: float | str | Mapping[str, float], shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Gain of every pixel [e-/ADU], or one of all."""
    if not isinstance(gains, str | Mapping):
        return _checked(np.asarray(float(gains)), "gains")
    if isinstance(gains, str) and gains != "detector":
        raise SensorError(
            f"gains = {gains!r} must be a number, 'detector', or gains by amplifier"
        )
    detector = exposure.getDetector() if hasattr(exposure, "getDetector") else None
    if detector is None:
        raise SensorError(
            "gains by amplifier need an exposure with a detector: give one gain"
        )
    # An exposure that was cut out of a sensor keeps the sensor's coordinates.
    left, low = exposure.getXY0() if hasattr(exposure, "getXY0") else (0, 0)
    out = np.full(shape, np.nan)
    for amplifier in detector:
        name, box = amplifier.getName(), amplifier.getBBox()
        if isinstance(gains, str):
            gain = float(amplifier.getGain())
        elif name in gains:
            gain = float(gains[name])
        else:
            raise SensorError(f"gains lack amplifier {name}: they have {', '.join(gains)}")
        first_y, first_x = max(box.getMinY() - low, 0), max(box.getMinX() - left, 0)
        last_y, last_x = max(box.getMaxY() + 1 - low, 0), max(box.getMaxX() + 1 - left, 0)
        out[first_y:last_y, first_x:last_x] = _checked(np.asarray(gain), f"gain of {name}")
    if np.isnan(out).any():
        raise SensorError(
            f"{np.isnan(out).sum()} pixels of the exposure belong to no amplifier of its detector"
        )
    return out


def _checked(gain: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    if not (np.isfinite(gain) and gain > 0):
        raise SensorError(f"{name} = {gain} e-/ADU must be finite and above 0")
    return gain
