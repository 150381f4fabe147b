"""Units and constants: quantities with units at the edge, plain floats inside.

Inside the package lengths are in um, potentials in V, charge in electrons, temperature in
K, densities in electron/um^3 and doses in electron/um^2.
"""

from __future__ import annotations

import astropy.units as u

from bfsensor.errors import DeviceError

VACUUM_PERMITTIVITY = 55.26349406
"""Vacuum permittivity [electron / (V um)]: 8.8541878188e-12 F/m / 1.602176634e-19 C
(CODATA 2022)."""

BOLTZMANN = 8.617333262e-5
"""Boltzmann constant [eV/K] (CODATA 2022, exact), so kT/q in volts."""

INTERNAL = {
    "length": u.um,
    "potential": u.V,
    "temperature": u.K,
    "angle": u.rad,
    "density": u.um**-3,
    "dose": u.um**-2,
    "number": u.dimensionless_unscaled,
}
"""The unit of each kind of quantity inside the package."""


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
        quantity = u.Quantity(text)
    except (TypeError, ValueError):
        raise DeviceError(
            f"{text!r} is not a number with a unit, such as '100 um'"
        ) from None
    unit = INTERNAL[kind]
    if quantity.unit == u.dimensionless_unscaled and kind != "number":
        raise DeviceError(f"{text!r} has no unit; expected one of {kind}, such as {unit}")
    try:
        return float(quantity.to_value(unit))
    except u.UnitConversionError:
        raise DeviceError(
            f"{text!r} is not a {kind}; expected a unit such as {unit}"
        ) from None


def from_internal(value: float, kind: str, unit: str) -> str:
    """Write a float in internal units as a quantity in ``unit``.

    Parameters
    ----------
    value : float
        In the internal unit of ``kind``.
    kind : str
        A key of :data:`INTERNAL`.
    unit : str
        Unit to write in.

    Returns
    -------
    text : str

    Examples
    --------
    >>> from_internal(10000.0, "dose", "cm-2")
    '1e+12 cm-2'
    """
    number = (value * INTERNAL[kind]).to_value(u.Unit(unit))
    for digits in range(1, 18):
        text = f"{number:.{digits}g}"
        if to_internal(f"{text} {unit}", kind) == value:
            break
    return f"{text} {unit}".strip()
