"""Internal units of the package, and physical constants in these units.

Lengths are in um, potentials in V, charge in electrons, temperature in K, densities in
electron/um^3 and doses in electron/um^2; :mod:`bfsensor.device.written_units` converts them from and
to text with units.
"""

from __future__ import annotations

VACUUM_PERMITTIVITY = 55.26349362
"""Vacuum permittivity [electron / (V um)]: 8.8541878188e-12 F/m / 1.602176634e-19 C
(CODATA 2022)."""

BOLTZMANN = 8.617333262e-5
"""Boltzmann constant [eV/K] (CODATA 2022, exact), so kT/q in volts."""

ELECTRON_MASS = 5.685630e-24
"""Mass of the free electron over its charge [V s^2 / um^2]: 9.1093837e-31 kg / 1.602176634e-19 C
(CODATA 2022), times 1e-12 m^2/um^2."""

ZERO_CELSIUS = 273.15
"""0 deg C [K], exact by definition."""


def to_kelvin(celsius: float) -> float:
    """Convert a temperature from deg C to K, rounded to 1e-6 K.

    :func:`to_celsius` restores the number exactly if it has at most six decimals.

    Parameters
    ----------
    celsius : float
        Temperature [deg C].

    Returns
    -------
    kelvin : float
        Temperature [K].

    Examples
    --------
    >>> to_kelvin(-100.0), to_celsius(to_kelvin(-100.0))
    (173.15, -100.0)
    """
    return round(celsius + ZERO_CELSIUS, 6)


def to_celsius(kelvin: float) -> float:
    """Convert a temperature from K to deg C, rounded to 1e-6 K.

    :func:`to_kelvin` restores the number exactly if it has at most six decimals.

    Parameters
    ----------
    kelvin : float
        Temperature [K].

    Returns
    -------
    celsius : float
        Temperature [deg C].

    Examples
    --------
    >>> to_celsius(173.15)
    -100.0
    """
    return round(kelvin - ZERO_CELSIUS, 6)
