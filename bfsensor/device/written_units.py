"""Conversion of quantities: text with a unit in device files, plain floats inside the package."""

from __future__ import annotations

from functools import cache

import astropy.units as u
import numpy as np

from bfsensor.errors import DeviceError

INTERNAL = {
    "length": u.um,
    "potential": u.V,
    "temperature": u.K,
    "angle": u.rad,
    "field": u.V / u.um,
    "density": u.um**-3,
    "dose": u.um**-2,
    "number": u.dimensionless_unscaled,
}
"""Unit of each kind of quantity inside the package, by definition."""

LONGEST = 100
"""Largest number of characters of a quantity.  Chosen: a number of 17 digits and the longest unit of a
device file have 30; units of 10,000 letters take a second to be refused, and of 200 nothing changes."""


def to_internal(text: str, kind: str) -> float:
    """Convert a quantity such as ``'100 um'`` to a float in the internal unit.

    Parameters
    ----------
    text : str
        Number and unit.
    kind : str
        A key of :data:`INTERNAL`.

    Returns
    -------
    value : float
        The quantity [internal unit].

    Raises
    ------
    DeviceError
        Not a quantity, no unit, or the wrong dimension.

    Examples
    --------
    >>> round(to_internal("1e12 cm-2", "dose"), 6)
    10000.0
    """
    try:
        quantity = u.Quantity(text) if len(text) <= LONGEST else None
    except (TypeError, ValueError):
        quantity = None
    if quantity is None or not quantity.isscalar:
        raise DeviceError(f"{text!r} is not a number with a unit, such as '100 um'")
    unit = INTERNAL[kind]
    if quantity.unit == u.dimensionless_unscaled and kind != "number":
        raise DeviceError(
            f"{text!r} has no unit; expected one of {kind}, such as {_name(kind)}"
        )
    try:
        times, over = _ratio(quantity.unit, unit)
        return float(quantity.value) * times / over
    except OverflowError:
        raise DeviceError(
            f"{text!r} has a unit of no finite size; expected one of {kind}, such as {_name(kind)}"
        ) from None
    except u.UnitConversionError:
        expected = f"a unit such as {_name(kind)}" if kind != "number" else "no unit"
        raise DeviceError(f"{text!r} is not a {kind}; expected {expected}") from None


@cache
def _ratio(given: u.UnitBase, wanted: u.UnitBase) -> tuple[float, float]:
    """Return the size of a unit in another as a fraction, so that powers of ten are exact.

    1e-8 is not a float, 1e8 is: '1e12 cm-2' becomes 1e4 only by a division.
    """
    size = float(given.to(wanted))
    if not 0 < size < np.inf:
        raise OverflowError
    power = round(np.log10(size))
    if abs(power) <= 22 and np.isclose(size, 10.0**power, rtol=1e-13, atol=0):
        return (10.0**power, 1.0) if power >= 0 else (1.0, 10.0**-power)
    return size, 1.0


def _name(kind: str) -> str:
    """Return the internal unit of a kind as it is written, such as 'um-2'."""
    return str(INTERNAL[kind].to_string(fraction=False))


def from_internal(value: float, kind: str, unit: str) -> str:
    """Write a float in internal units as the shortest text that reads as the same float.

    The few floats that no number in ``unit`` gives back bit for bit are written in the internal
    unit instead.

    Parameters
    ----------
    value : float
        The quantity [internal unit of ``kind``].
    kind : str
        A key of :data:`INTERNAL`.
    unit : str
        Unit to write in, of the dimension of ``kind``.

    Returns
    -------
    text : str
        Number and unit; :func:`to_internal` reads the same float from it.

    Examples
    --------
    >>> from_internal(10000.0, "dose", "cm-2")
    '1e+12 cm-2'
    """
    times, over = _ratio(u.Unit(unit), INTERNAL[kind])
    number = float(value) * over / times
    if not np.isfinite(number):
        return f"{number} {unit}".strip()
    for digits in range(1, 18):
        mantissa, exponent = f"{number:.{digits - 1}e}".split("e")
        plain = f"{number:.{max(digits - 1 - int(exponent), 0)}f}"
        text = plain if -5 <= int(exponent) < 6 else f"{mantissa}e{exponent}"
        # As to_internal reads it, without parsing the unit for each number of digits.
        if float(text) * times / over == value:
            return f"{text} {unit}".strip()
    return f"{float(value)!r} {_name(kind)}".strip()
