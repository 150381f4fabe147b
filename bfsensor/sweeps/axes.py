"""What a sweep goes over: quantities of a device and the light, with their values."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import astropy.units as u
import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.written_units import to_internal
from bfsensor.errors import DeviceError, SweepError

WAVELENGTH = "wavelength"
"""Name of the light's wavelength, which is no quantity of a device."""


@dataclass(frozen=True)
class Swept:
    """A quantity and the values it takes.

    Attributes
    ----------
    name : str
        Dotted name in a device, or :data:`WAVELENGTH`.
    unit : str
        Unit of ``values``; empty for numbers.
    values : tuple of float
        In ``unit``, in the order given.
    texts : tuple of str
        The same with units, as :meth:`bfsensor.device.device.Device.with_value` takes them.
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
    """Read what to sweep over.

    Parameters
    ----------
    key : str
        Quantity of the device, dotted or short where that is unique, or ``wavelength``.
    text : str
        Quantities with units: a list ``-30V,-50V,-70V``, or first, last and number of values
        equally far from each other, ``-30V:-70V:5``.
    device : Device
        To be swept.

    Returns
    -------
    Swept

    Raises
    ------
    DeviceError
        No such quantity (the message names all there are); no unit or the wrong one.
    SweepError
        Neither a list nor first:last:number.

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
        if not count.isdecimal() or int(count) < 2 or "," in text:
            raise SweepError(
                f"{name}: {text!r} is neither a list such as -30V,-50V nor "
                "first:last:number of values, from 2, such as -30V:-70V:5"
            )
        first, last = (_number(name, end, kind, unit) for end in ends[:2])
        # Twelve digits: -35 V is meant, not -35.00000000000001 V.
        numbers = [float(f"{v:.12g}") for v in np.linspace(first, last, int(count))]
    if name == WAVELENGTH and not all(v > 0 for v in numbers):
        raise DeviceError(f"wavelength: {min(numbers):g} nm must be above 0 nm")
    if not kind:
        if any(v != round(v) for v in numbers):
            raise DeviceError(f"{name}: {text!r} must give whole numbers")
        return Swept(name, "", tuple(numbers), tuple(f"{v:.0f}" for v in numbers))
    texts = tuple(f"{v:.15g} {unit}".strip() for v in numbers)
    return Swept(name, unit, tuple(numbers), texts)


def _known(key: str, device: Device) -> tuple[str, str, str]:
    """Name, kind and unit of a quantity, or all there are."""
    if key == WAVELENGTH:
        return WAVELENGTH, "length", "nm"
    try:
        return device.unit_of(key)
    except DeviceError:
        raise DeviceError(
            f"no quantity {key!r} to sweep over; there are wavelength and, of "
            f"{device.name}, {', '.join(device.quantities)} (the last part is enough where "
            "it is unique)"
        ) from None


def _number(name: str, text: str, kind: str, unit: str) -> float:
    """Value of a text with unit, in the unit that is written."""
    try:
        if not kind:
            return float(int(text))
        to_internal(text, kind)  # says what is wrong
        # Fifteen digits: 0.08 mm are 80 um, not 80.00000000000001 um.
        return float(f"{u.Quantity(text).to_value(u.Unit(unit)):.15g}")
    except ValueError as error:
        fault = error if isinstance(error, DeviceError) else f"{text!r} is no whole number"
        raise DeviceError(f"{name}: {fault}") from None


def combine(swept: Sequence[Swept], *, paired: bool = False) -> list[tuple[int, ...]]:
    """Give the points of a sweep: for each, the place of the value of every quantity.

    Parameters
    ----------
    swept : sequence of Swept
        At least one, no quantity twice.
    paired : bool
        Take the first values together, then the second ones, and so on, instead of every
        value of one with every value of the others.

    Returns
    -------
    list of tuple of int
        The last quantity varies fastest.

    Raises
    ------
    SweepError
        Nothing to sweep over, one quantity twice, or pairs of unlike lengths.

    Examples
    --------
    >>> two = [Swept("a.b", "V", (1.0, 2.0), ("1 V", "2 V")),
    ...        Swept("c.d", "um", (5.0, 6.0), ("5 um", "6 um"))]
    >>> combine(two), combine(two, paired=True)
    ([(0, 0), (0, 1), (1, 0), (1, 1)], [(0, 0), (1, 1)])
    """
    if not swept:
        raise SweepError("nothing to sweep over; say for example back_bias=-30V:-70V:5")
    names = [s.name for s in swept]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise SweepError(f"{twice[0]} is given twice; give its values as one list")
    counts = [len(s.values) for s in swept]
    if not paired:
        return list(itertools.product(*map(range, counts)))
    if len(set(counts)) > 1:
        given = ", ".join(f"{s.short} {len(s.values)}" for s in swept)
        raise SweepError(
            f"paired quantities must have as many values as each other: {given}"
        )
    return [(n,) * len(swept) for n in range(counts[0])]
