"""Axes of a sweep: quantities of a device, or the wavelength of the light, with their values."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import astropy.units as u
import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.silicon import ABSORPTION_RANGE
from bfsensor.device.written_units import to_internal
from bfsensor.errors import DeviceError, SweepError

WAVELENGTH = "wavelength"
"""Name of the axis for the vacuum wavelength of the light, which is no quantity of a device."""

MOST = 100_000
"""Largest number of values of an axis, and of points of a sweep.

Chosen: at some 5 CPU seconds a point they take six days; twice as many take twice as long, and a
billion, which a slip of the finger asks for, more memory than there is."""

LIMIT = f"a sweep has at most {MOST:,}; give fewer values"


@dataclass(frozen=True)
class Swept:
    """A swept quantity and the values that it takes.

    Attributes
    ----------
    name : str
        Dotted name in a device, or :data:`WAVELENGTH`.
    unit : str
        Unit of ``values``; empty for numbers.
    values : tuple of float
        Values [``unit``], in the order given.
    texts : tuple of str
        The same with units, as :meth:`bfsensor.device.device.Device.with_value` takes them.

    Examples
    --------
    >>> Swept("operating_point.back_bias", "V", (-50.0,), ("-50 V",)).short
    'back_bias'
    """

    name: str
    unit: str
    values: tuple[float, ...]
    texts: tuple[str, ...]

    @property
    def short(self) -> str:
        """Name without its section."""
        return self.name.rpartition(".")[2]


def parse_swept(key: str, text: str, device: Device) -> Swept:
    """Read one axis of a sweep from text.

    Parameters
    ----------
    key : str
        Name of a quantity of the device, dotted, or its last part where that is unique; or
        ``wavelength``.
    text : str
        Values with units: a list ``-30V,-50V,-70V``; or first value, last value and number of
        equally spaced values, at least 2, ``-30V:-70V:5``.
    device : Device
        The device to be swept.

    Returns
    -------
    Swept
        Values in the unit in which device files write the quantity; wavelengths in nm.

    Raises
    ------
    DeviceError
        No such quantity (the message lists all), a missing or wrong unit, a fraction where a
        whole number is wanted, or a wavelength outside
        :data:`bfsensor.device.silicon.ABSORPTION_RANGE`.
    SweepError
        The text is neither a list nor first:last:number, or has too many values.

    Examples
    --------
    >>> device = Device.load("itl_sta3800c")
    >>> parse_swept("back_bias", "-30V:-70V:3", device).texts
    ('-30 V', '-50 V', '-70 V')
    >>> parse_swept("wavelength", "0.4um,900nm", device).values
    (400.0, 900.0)
    """
    name, kind, unit = _known(key, device)
    parts = [part.strip() for part in text.split(",")]
    if ":" not in text:
        numbers = [_number(name, part, kind, unit) for part in parts]
    else:
        ends = text.split(":")
        count = ends[2].strip() if len(ends) == 3 else ""
        # Compared as texts first: a number of thousands of digits is no int in Python.
        if count.isdecimal() and (len(count) > len(str(MOST)) or int(count) > MOST):
            raise SweepError(f"{name}: {_short(count)} values; {LIMIT}")
        if not count.isdecimal() or int(count) < 2 or "," in text:
            raise SweepError(
                f"{name}: {text!r} is neither a list such as -30V,-50V nor "
                "first:last:number of values (at least 2) such as -30V:-70V:5"
            )
        first, last = (_number(name, end, kind, unit) for end in ends[:2])
        # Twelve digits remove the round-off of linspace: -35 V, not -35.00000000000001 V.
        numbers = [float(f"{v:.12g}") for v in np.linspace(first, last, int(count))]
    low, high = ABSORPTION_RANGE
    if name == WAVELENGTH and (wrong := [v for v in numbers if not low <= v <= high]):
        raise DeviceError(
            f"wavelength: {wrong[0]:g} nm must be from {low:g} to {high:g} nm, where silicon's "
            "absorption is known"
        )
    if not kind:
        if any(v != round(v) for v in numbers):
            raise DeviceError(f"{name}: {text!r} must give whole numbers")
        return Swept(name, "", tuple(numbers), tuple(f"{v:.0f}" for v in numbers))
    texts = tuple(f"{v:.15g} {unit}".strip() for v in numbers)
    return Swept(name, unit, tuple(numbers), texts)


def _short(text: str) -> str:
    """Text for a message, cut after 30 characters."""
    return text if len(text) <= 30 else f"{text[:30]} ({len(text)} digits)"


def _known(key: str, device: Device) -> tuple[str, str, str]:
    """Full name, kind and unit of a quantity; the error lists all quantities."""
    if key == WAVELENGTH:
        return WAVELENGTH, "length", "nm"
    try:
        return device.unit_of(key)
    except DeviceError:
        raise DeviceError(
            f"no quantity {key!r} to sweep over; allowed are wavelength and the quantities of "
            f"{device.name}: {', '.join(device.quantities)} (the last part of a name is enough "
            "where it is unique)"
        ) from None


def _number(name: str, text: str, kind: str, unit: str) -> float:
    """Value of a text with unit, converted to ``unit``."""
    try:
        if not kind:
            return float(int(text))
        # Raises the error that names the fault of the text.
        if not np.isfinite(to_internal(text, kind)):
            raise DeviceError(f"{text!r} must be a finite value")
        # Fifteen digits remove the round-off of the conversion: 0.08 mm are 80 um, not
        # 80.00000000000001 um.
        return float(f"{u.Quantity(text).to_value(u.Unit(unit)):.15g}")
    except ValueError as error:
        fault = error if isinstance(error, DeviceError) else f"{text!r} is no whole number"
        raise DeviceError(f"{name}: {fault}") from None


def combine(swept: Sequence[Swept], *, paired: bool = False) -> list[tuple[int, ...]]:
    """Combine the axes of a sweep to points: for each point, an index into every axis's values.

    Parameters
    ----------
    swept : sequence of Swept
        At least one axis, no quantity twice.
    paired : bool
        Take the first values together, then the second ones, and so on, instead of every
        value of one with every value of the others.

    Returns
    -------
    list of tuple of int
        One tuple a point; the last axis varies fastest.

    Raises
    ------
    SweepError
        No axis, one quantity twice, paired axes of unequal lengths, or too many points.

    Examples
    --------
    >>> two = [Swept("a.b", "V", (1.0, 2.0), ("1 V", "2 V")),
    ...        Swept("c.d", "um", (5.0, 6.0), ("5 um", "6 um"))]
    >>> combine(two), combine(two, paired=True)
    ([(0, 0), (0, 1), (1, 0), (1, 1)], [(0, 0), (1, 1)])
    """
    if not swept:
        raise SweepError("nothing to sweep over; give for example back_bias=-30V:-70V:5")
    names = [s.name for s in swept]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise SweepError(f"{twice[0]} is given twice; give its values as one list")
    counts = [len(s.values) for s in swept]
    if not paired:
        if (points := math.prod(counts)) > MOST:
            raise SweepError(f"{' x '.join(map(str, counts))} = {points:,} points; {LIMIT}")
        return list(itertools.product(*map(range, counts)))
    if len(set(counts)) > 1:
        given = ", ".join(f"{s.short} {len(s.values)}" for s in swept)
        raise SweepError(
            f"paired quantities must have equal numbers of values, not {given}"
        )
    return [(n,) * len(swept) for n in range(counts[0])]
