# ruff: noqa: D102  (protocols: the class says what its attributes are)
"""Protocols of exposures and frames, their conditions, and the fold that each is assigned to."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.units import to_celsius

NUMBERS = ("wavelength", "back_bias", "temperature")
"""Axes of a channel that hold the condition of its values [nm, V, K]; nan where not known."""

REPEATS = 8
"""Degrees of freedom from which the scatter of repeated measurements is their error.  Chosen: it is then
known to 25 %; with 16, to 18 %."""

LAMP_ERROR = 1e-3
"""Relative error of a lamp monitor reading, of recordings and of planned ones, where none is stated.
Chosen, to be derived: twice as large halves the significance of nonlinearity, drift and loss in the
means of flats."""


def condition_of(exposure: ExposureInfo) -> Condition:
    """Condition of an exposure, rounded to 0.01 nm, V and K so that repeated headers agree."""
    given = exposure.wavelength, exposure.back_bias, exposure.temperature
    return condition_at(np.nan if v is None else round(float(v), 2) for v in given)


def condition_at(numbers: Iterable[float]) -> Condition:
    """Condition from values of :data:`NUMBERS` [nm, V, K]; nan becomes None."""
    wavelength, back_bias, temperature = (
        float(v) if np.isfinite(v) else None for v in numbers
    )
    return Condition(wavelength=wavelength, back_bias=back_bias, temperature=temperature)


def numbers_of(condition: Condition) -> tuple[float, float, float]:
    """Values of :data:`NUMBERS` at a condition [nm, V, K]; None becomes nan."""
    wavelength, back_bias, temperature = (
        np.nan if v is None else v
        for v in (condition.wavelength, condition.back_bias, condition.temperature)
    )
    return wavelength, back_bias, temperature


def label_of(condition: Condition) -> str:
    """Condition in names of maps and parameters, such as '620/-60/-100' [nm, V, deg C]."""
    wavelength, back_bias, temperature = numbers_of(condition)
    return f"{wavelength:g}/{back_bias:g}/{to_celsius(temperature):g}"


class Axes:
    """Coordinate columns of a channel that grow block by block."""

    def __init__(self) -> None:
        self._parts: dict[str, list[NDArray]] = {}

    def add(self, count: int, condition: Condition, **columns: object) -> None:
        """Add ``count`` rows at one condition; scalars are repeated."""
        known = dict(zip(NUMBERS, numbers_of(condition), strict=True))
        for name, value in {**known, **columns}.items():
            self._parts.setdefault(name, []).append(
                np.broadcast_to(np.asarray(value), (count,))
            )

    def columns(self) -> dict[str, NDArray]:
        """All rows by the name of the column."""
        return {name: np.concatenate(parts) for name, parts in self._parts.items()}


class ExposureInfo(Protocol):
    """Header of an exposure as the channels need it; None where a number is not known.

    Attributes
    ----------
    number : int
        Number of the exposure in its campaign.
    kind : str
        'bias', 'dark', 'flat', 'spot' or another word, which is not measured.
    exposure_time, wavelength, back_bias, temperature : float or None
        Exposure time [s], wavelength [nm], back bias [V], temperature [K].
    lamp : float or None
        Reading of the lamp monitor, in proportion to the light per second.
    mjd : float or None
        Time at which it was taken [d, MJD].
    pair : int or None
        Number of the pair that a flat belongs to.
    """

    @property
    def number(self) -> int: ...
    @property
    def kind(self) -> str: ...
    @property
    def exposure_time(self) -> float | None: ...
    @property
    def wavelength(self) -> float | None: ...
    @property
    def back_bias(self) -> float | None: ...
    @property
    def temperature(self) -> float | None: ...
    @property
    def lamp(self) -> float | None: ...
    @property
    def mjd(self) -> float | None: ...
    @property
    def pair(self) -> int | None: ...


class Frame(Protocol):
    """One amplifier's frame as the channels need it, arrays in readout order [ADU].

    Attributes
    ----------
    name : str
        Name of the amplifier.
    pixels : ndarray, shape (rows, columns)
        The whole frame, with prescan and overscans.
    mask : ndarray of bool, shape of ``image``
        Pixels that are not used.
    image, prescan, serial_overscan, parallel_overscan : ndarray
        Parts of the frame; of size 0 where there is none.
    flip_x, flip_y : bool
        Whether readout runs towards smaller x or y on the sensor.
    origin : (int, int) or None
        Lower left corner (x, y) of the image on the sensor [pixel].
    """

    @property
    def name(self) -> str: ...
    @property
    def pixels(self) -> NDArray[np.float32]: ...
    @property
    def mask(self) -> NDArray[np.bool_]: ...
    @property
    def image(self) -> NDArray[np.float32]: ...
    @property
    def prescan(self) -> NDArray[np.float32]: ...
    @property
    def serial_overscan(self) -> NDArray[np.float32]: ...
    @property
    def parallel_overscan(self) -> NDArray[np.float32]: ...
    @property
    def flip_x(self) -> bool: ...
    @property
    def flip_y(self) -> bool: ...
    @property
    def origin(self) -> tuple[int, int] | None: ...


def zero_pixels(frame: Frame) -> NDArray[np.float32]:
    """Pixels that give the zero of a frame: half of its serial, or else its parallel, overscan.

    That half is the one which charge deferred from the image does not reach.  The array is empty
    where the frame has neither.
    """
    over, below = frame.serial_overscan, frame.parallel_overscan
    return over[:, over.shape[1] // 2 :] if over.size else below[len(below) // 2 :]


def overscan_level(frame: Frame) -> float:
    """Level of a frame's overscan [ADU], by :func:`zero_pixels`; 0 without one."""
    over = zero_pixels(frame)
    return float(np.mean(over, dtype=np.float64)) if over.size else 0.0


class Source(Protocol):
    """A campaign that gives exposures in order of time, and reads their frames.

    Attributes
    ----------
    exposures : sequence of ExposureInfo
        Headers of all exposures, in order of time.
    lamp_error : float
        Relative error of the lamp monitor, above 0.
    shape : (int, int)
        Rows and columns of the sensor.
    read : callable
        Returns the frames of an exposure, one for each amplifier, always in the same order.
    """

    @property
    def exposures(self) -> Sequence[ExposureInfo]: ...
    @property
    def lamp_error(self) -> float: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    def read(self, exposure: Any) -> Sequence[Any]: ...


HELD = 5
"""One in so many exposures of a kind (other than flats) is held out, the fourth first, if there
are at least twice as many.  Chosen, to be derived: with 10, half as many are held out, of kinds
with 20 or more."""


def is_held_out(place: int, count: int) -> bool:
    """Whether an exposure other than a flat, or a pair of biases, is held out of all fits.

    Parameters
    ----------
    place : int
        Its index among those of its kind in order of time, from 0.
    count : int
        Number of those of its kind.

    Returns
    -------
    bool

    Examples
    --------
    >>> [n for n in range(12) if is_held_out(n, 12)], is_held_out(3, 8)
    ([3, 8], False)
    """
    return count >= 2 * HELD and place % HELD == HELD - 2


def assign_folds(pairs: Iterable[int], shift: int = 0) -> list[str]:
    """Assign pairs of flats of one level to folds: three of five fit, one selects, one is held out.

    Parameters
    ----------
    pairs : iterable
        The pairs, in order of time.
    shift : int
        Offset of the pattern, different for each level, so that all folds are filled even with
        few pairs per level.

    Returns
    -------
    folds : list of str
        'fit', 'select' or 'held-out' for each pair; a single pair is fitted.

    Examples
    --------
    >>> assign_folds(range(4))
    ['fit', 'held-out', 'fit', 'select']
    """
    pattern = ("fit", "held-out", "fit", "select", "fit")
    given = list(pairs)
    if len(given) == 1:
        return ["fit"]
    if len(given) == 2:
        return ["fit", ("held-out", "select")[shift % 2]]
    return [pattern[(n + (shift if len(given) >= 5 else 0)) % 5] for n in range(len(given))]


def zero_folds(place: int, count: int) -> tuple[str, ...]:
    """Folds whose overscans have their zero from a bias.

    The folds are independent only if each has biases of its own; with fewer than
    four all biases serve all folds.

    Parameters
    ----------
    place : int
        Index of the bias in order of time, from 0.
    count : int
        Number of biases.

    Returns
    -------
    folds : tuple of str

    Examples
    --------
    >>> [zero_folds(n, 4) for n in range(4)], zero_folds(0, 3)
    ([('fit',), ('held-out',), ('fit',), ('select',)], ('fit', 'select', 'held-out'))
    """
    return (
        (assign_folds(range(count))[place],)
        if count >= 4
        else ("fit", "select", "held-out")
    )
