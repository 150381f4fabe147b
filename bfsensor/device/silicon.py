r"""Laws of silicon, each with its source and range: absorption length, mobility of electrons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import DeviceError
from bfsensor.typing import FloatArray
from bfsensor.units import BOLTZMANN

_HC = 1239.841984
"""Photon energy times wavelength [eV nm] (CODATA 2022, exact)."""

_TEMPERATURES = (77.0, 500.0)
"""Lowest and highest temperature [K] of both laws.

The upper end is published, the end of the range of Rajkanan et al. (1979).  The lower is chosen:
nitrogen's boiling point, the lowest temperature that a device may have."""

_ROOM = 300.0
"""Temperature [K] of the measured absorption: Green (2008)."""

_WAVELENGTHS = np.arange(250.0, 1451.0, 10.0)
"""Vacuum wavelengths of the measured absorption [nm]: Green (2008), table 1."""

ABSORPTION_RANGE = (250.0, 1450.0)
"""Range of wavelengths in which the absorption was measured [nm]: published, Green (2008), table 1."""

_ABSORPTION = np.array([
    1.84e6, 1.97e6, 2.18e6, 2.37e6, 2.29e6, 1.77e6, 1.46e6, 1.30e6, 1.18e6, 1.10e6,
    1.06e6, 1.04e6, 7.37e5, 3.13e5, 1.43e5, 9.30e4, 6.95e4, 5.27e4, 4.02e4, 3.07e4,
    2.41e4, 1.95e4, 1.66e4, 1.44e4, 1.26e4, 1.11e4, 9700, 8800, 7850, 7050,
    6390, 5780, 5320, 4880, 4490, 4175, 3800, 3520, 3280, 3030,
    2790, 2570, 2390, 2200, 2040, 1890, 1780, 1680, 1540, 1420,
    1310, 1190, 1100, 1030, 928, 850, 775, 707, 647, 590,
    534, 479, 431, 383, 343, 303, 271, 240, 209, 183,
    156, 134, 113, 96.0, 79.0, 64.0, 51.1, 39.9, 30.2, 22.6,
    16.3, 11.1, 8.0, 6.2, 4.7, 3.5, 2.7, 2.0, 1.5, 1.0,
    0.68, 0.42, 0.22, 6.5e-2, 3.6e-2, 2.2e-2, 1.3e-2, 8.2e-3, 4.7e-3, 2.4e-3,
    1.0e-3, 3.6e-4, 2.0e-4, 1.2e-4, 7.1e-5, 4.5e-5, 2.7e-5, 1.6e-5, 8.0e-6, 3.5e-6,
    1.7e-6, 9.5e-7, 6.0e-7, 3.8e-7, 2.3e-7, 1.4e-7, 8.5e-8, 5.0e-8, 2.5e-8, 1.8e-8,
    1.2e-8,
])  # fmt: skip
"""Absorption coefficient [cm^-1] at 300 K at those wavelengths: Green (2008), table 1."""

_GAPS = ((1.1557, 3.231e2), (2.5, 7.237e3))
"""Indirect gaps at 0 K [eV] with strengths [cm^-1 eV^-2]: Rajkanan et al. (1979)."""

_PHONONS = ((1.827e-2, 5.5), (5.773e-2, 4.0))
"""Phonon energies [eV] with couplings: Rajkanan et al. (1979)."""

_SHRINK, _SHRINK_TEMPERATURE = 7.021e-4, 1108.0
# Coefficients of the shrinking of the gaps [eV/K, K]: Rajkanan et al. (1979).

_LAST_RATIO = 1100.0
"""Wavelength [nm] beyond which the change of the absorption with temperature is held constant.

Chosen: towards the gap the terms of the law vanish one after another, and with them the ratio of
two temperatures.  At twice the wavelength, beyond all gaps, the ratio would be 0 / 0."""


def absorption_length(wavelength: ArrayLike, temperature: float) -> FloatArray:
    r"""Return the absorption length of light in silicon.

    Measured at 300 K, carried to other temperatures by phonon-assisted transitions:

    .. math::
        \frac{1}{\alpha} \quad\text{with}\quad
        \alpha(\lambda, T) = \alpha_{300}(\lambda) \frac{R(E, T)}{R(E, 300)}, \qquad
        R = \sum_{ij} C_i A_j \left[
            \frac{(E - E_j + \epsilon_i)^2}{e^{\epsilon_i/kT} - 1}
            + \frac{(E - E_j - \epsilon_i)^2}{1 - e^{-\epsilon_i/kT}} \right],

    every term only where its bracket is positive, and gaps that shrink as
    :math:`E_j(T) = E_j(0) - \beta T^2 / (T + \gamma)`.

    Parameters
    ----------
    wavelength : array_like
        Wavelength in vacuum [nm], at least 0.  Below 250 nm the length at 250 nm is returned.
    temperature : float
        Temperature of the silicon, 77 to 500 K.

    Returns
    -------
    length : ndarray
        Absorption length [um], shape of ``wavelength``; inf above 1450 nm, where the
        measurements end.

    Raises
    ------
    DeviceError
        A wavelength that is negative or not a number; a temperature outside the range.

    Notes
    -----
    At 300 K: Green (2008), interpolated in :math:`\log \alpha`.  Schinke et al. (2015) at
    295 K, which is the table that GalSim ships, differ by 5 % rms and by at most 14 % over
    350 to 1000 nm.

    Rajkanan et al. cover 1.1 to 4.0 eV (310 to 1127 nm) and 20 to 500 K, within about 20 %.
    Against both tables at 300 K their law has the shape but not the strength: over 600 to
    1030 nm its lengths are short by a nearly constant factor 1.5.  Hence only its change
    with temperature is used, without the direct gap, which would put a step at 390 nm.
    Beyond 1100 nm the ratio at 1100 nm is kept; there, and below 310 nm, the change with
    temperature is an estimate.

    They agree with the dispersion model of Franta et al. (2017) within a factor 1.6 over 400 to
    1000 nm from 150 to 400 K; at 1050 nm and 150 K they are shorter by a factor 1.9.  The power
    law in temperature of Green (2008) departs nearly twice as far from that model at 150 K and
    below.

    References
    ----------
    Green 2008, Sol. Energy Mater. Sol. Cells 92, 1305, table 1; Rajkanan, Singh &
    Shewchun 1979, Solid-State Electronics 22, 793; Schinke et al. 2015, AIP Advances 5,
    067168; Franta et al. 2017, Appl. Surf. Sci. 421, 405.

    Examples
    --------
    >>> absorption_length([400.0, 900.0], 300.0).round(3)
    array([ 0.108, 33.003])
    >>> absorption_length([400.0, 900.0], 173.0).round(3)
    array([ 0.175, 66.771])
    """
    wave = np.asarray(wavelength, dtype=float)
    bad = wave[~(wave >= 0)]
    if bad.size:
        raise DeviceError(f"wavelength = {bad.flat[0]} nm must be a number from 0 nm")
    _check_temperature(temperature)
    alpha = np.exp(np.interp(wave, _WAVELENGTHS, np.log(_ABSORPTION)))
    energy = _HC / np.clip(wave, _WAVELENGTHS[0], _LAST_RATIO)
    alpha *= _indirect(energy, temperature) / _indirect(energy, _ROOM)
    return np.where(wave > _WAVELENGTHS[-1], np.inf, 1e4 / alpha)


def _indirect(energy: FloatArray, temperature: float) -> FloatArray:
    """Absorption coefficient [cm^-1] across the indirect gaps for photons of an energy [eV]."""
    kt = BOLTZMANN * temperature
    shrink = _SHRINK * temperature**2 / (temperature + _SHRINK_TEMPERATURE)
    alpha = np.zeros_like(energy)
    for gap, strength in _GAPS:
        for phonon, coupling in _PHONONS:
            absorbed = np.maximum(energy - (gap - shrink) + phonon, 0.0)
            emitted = np.maximum(energy - (gap - shrink) - phonon, 0.0)
            alpha += strength * coupling * absorbed**2 / np.expm1(phonon / kt)
            alpha += strength * coupling * emitted**2 / -np.expm1(-phonon / kt)
    return alpha


def _check_temperature(temperature: float) -> None:
    """Refuse a temperature [K] outside the range of the laws."""
    low, high = _TEMPERATURES
    if not low <= temperature <= high:
        raise DeviceError(
            f"temperature = {temperature} K must be from {low:g} to {high:g} K"
        )


def mobility(field: ArrayLike, temperature: float) -> FloatArray:
    r"""Return the mobility of electrons in pure silicon.

    .. math:: \mu = \frac{v_m / E_c}{[1 + (E / E_c)^\beta]^{1/\beta}}, \quad
        v_m = 1.53 \times 10^9\, T^{-0.87}, \quad E_c = 1.01\, T^{1.55}, \quad
        \beta = 2.57 \times 10^{-2}\, T^{0.66}

    with :math:`v_m` in cm/s and :math:`E_c` in V/cm.

    Parameters
    ----------
    field : array_like
        Electric field [V/um], at least 0.
    temperature : float
        Temperature of the silicon, 77 to 500 K; the measurements behind the fit end at 430 K.

    Returns
    -------
    mobility : ndarray
        Drift velocity over field [um^2 / (V s)], shape of ``field``.

    Raises
    ------
    DeviceError
        A value outside the range.

    References
    ----------
    Jacoboni et al. 1977, Solid-State Electronics 20, 77, section 5.2 and table 5; range
    of temperature: Canali et al. 1975, IEEE Trans. Electron Devices 22, 1045.

    Examples
    --------
    >>> round(float(mobility(0.0, 300.0)) / 1e8)  # in cm^2 / (V s)
    1534
    """
    e = np.asarray(field, dtype=float)
    bad = e[~(e >= 0)]
    if bad.size:
        raise DeviceError(f"field = {bad.flat[0]} V/um must be a number from 0 V/um")
    _check_temperature(temperature)
    low, critical, beta = mobility_law(temperature)
    return np.asarray(low / (1 + (e / critical) ** beta) ** (1 / beta))


def mobility_law(temperature: float) -> tuple[float, float, float]:
    """Return the constants of :func:`mobility` at a temperature.

    Parameters
    ----------
    temperature : float
        Temperature of the silicon, 77 to 500 K.

    Returns
    -------
    low, critical, exponent : float
        Mobility in weak fields [um^2 / (V s)], critical field [V/um], exponent.
    """
    _check_temperature(temperature)
    velocity = 1.53e9 * temperature**-0.87 * 1e4  # um/s
    critical = 1.01 * temperature**1.55 * 1e-4  # V/um
    return velocity / critical, critical, 2.57e-2 * temperature**0.66
