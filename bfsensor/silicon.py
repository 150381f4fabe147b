r"""Laws of silicon: what light and electrons do in it, each with its source and range."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import DeviceError
from bfsensor.units import BOLTZMANN

_HC = 1239.841984
"""Photon energy times wavelength [eV nm] (CODATA 2022, exact)."""

_TEMPERATURES = (77.0, 500.0)
_SHORTEST = 250.0  # nm; the law of absorption is not evaluated below

# Rajkanan, Singh & Shewchun (1979), table 1; energies in eV, amplitudes in cm^-1 eV^-2 and
# cm^-1 eV^-1/2.
_INDIRECT_GAPS = (1.1557, 2.5)
_INDIRECT = (3.231e2, 7.237e3)
_DIRECT_GAP, _DIRECT = 3.2, 1.052e6
_PHONONS = (1.827e-2, 5.773e-2)
_COUPLINGS = (5.5, 4.0)
_GAP_SLOPE, _GAP_TEMPERATURE = 7.021e-4, 1108.0  # eV/K, K


def absorption_length(wavelength: ArrayLike, temperature: float) -> NDArray[np.float64]:
    r"""Give the absorption length of silicon.

    Transitions across two indirect gaps with two phonons each, and a direct one:

    .. math::
        \alpha = \sum_{ij} C_i A_j \left[
            \frac{(E - E_j + E_{p,i})^2}{e^{E_{p,i}/kT} - 1}
            + \frac{(E - E_j - E_{p,i})^2}{1 - e^{-E_{p,i}/kT}} \right]
            + A_d (E - E_d)^{1/2},

    every term only where its bracket is positive, and gaps that shrink as
    :math:`E(0) - \beta T^2 / (T + \gamma)`.

    Parameters
    ----------
    wavelength : array_like
        In vacuum [nm], not negative.  Below 250 nm the length at 250 nm is given.
    temperature : float
        77 to 500 K.

    Returns
    -------
    length : ndarray
        [um]; inf where the law has no absorption, at long wavelengths.

    Raises
    ------
    DeviceError
        A wavelength that is negative or not a number; a temperature outside the range.

    Notes
    -----
    The authors state 1.1 to 4.0 eV (310 to 1127 nm), 20 to 500 K and an accuracy of about
    20 %.

    References
    ----------
    Rajkanan, Singh & Shewchun 1979, Solid-State Electronics 22, 793.

    Examples
    --------
    >>> cold, warm = (absorption_length(900.0, t) for t in (173.0, 300.0))
    >>> bool(1.5 < cold / warm < 2.5)
    True
    """
    wave = np.asarray(wavelength, float)
    if np.any(np.isnan(wave)) or np.any(wave < 0):
        bad = wave[np.isnan(wave) | (wave < 0)].flat[0]
        raise DeviceError(f"wavelength = {bad} nm must be a number from 0 nm")
    low, high = _TEMPERATURES
    if not low <= temperature <= high:
        raise DeviceError(
            f"temperature = {temperature} K must be from {low:g} to {high:g} K"
        )
    energy = _HC / np.maximum(wave, _SHORTEST)
    kt = BOLTZMANN * temperature
    shrink = _GAP_SLOPE * temperature**2 / (temperature + _GAP_TEMPERATURE)
    alpha = np.zeros_like(energy)
    for gap, strength in zip(_INDIRECT_GAPS, _INDIRECT, strict=True):
        for phonon, coupling in zip(_PHONONS, _COUPLINGS, strict=True):
            absorbed = np.maximum(energy - (gap - shrink) + phonon, 0.0)
            emitted = np.maximum(energy - (gap - shrink) - phonon, 0.0)
            alpha += strength * coupling * absorbed**2 / np.expm1(phonon / kt)
            alpha += strength * coupling * emitted**2 / -np.expm1(-phonon / kt)
    alpha += _DIRECT * np.sqrt(np.maximum(energy - (_DIRECT_GAP - shrink), 0.0))
    with np.errstate(divide="ignore"):
        return np.asarray(1e4 / alpha)


def mobility(field: ArrayLike, temperature: float) -> NDArray[np.float64]:
    r"""Give the mobility of electrons in silicon.

    .. math:: \mu = \frac{v_m / E_c}{[1 + (E / E_c)^\beta]^{1/\beta}}, \quad
        v_m = 1.53 \times 10^9\, T^{-0.87}, \quad E_c = 1.01\, T^{1.55}, \quad
        \beta = 2.57 \times 10^{-2}\, T^{0.66}

    with :math:`v_m` in cm/s and :math:`E_c` in V/cm.

    Parameters
    ----------
    field : array_like
        [V/um], not negative.
    temperature : float
        77 to 500 K; the measurements behind the fit end at 430 K.

    Returns
    -------
    mobility : ndarray
        [um^2 / (V s)]

    Raises
    ------
    DeviceError
        A value outside the range.

    References
    ----------
    Jacoboni et al. 1977, Solid-State Electronics 20, 77, table 5.

    Examples
    --------
    >>> round(float(mobility(0.0, 300.0)) / 1e8)  # in cm^2 / (V s)
    1534
    """
    e = np.asarray(field, float)
    if np.any(~(e >= 0)):
        raise DeviceError(
            f"field = {e[~(e >= 0)].flat[0]} V/um must be a number from 0 V/um"
        )
    low, high = _TEMPERATURES
    if not low <= temperature <= high:
        raise DeviceError(
            f"temperature = {temperature} K must be from {low:g} to {high:g} K"
        )
    velocity = 1.53e9 * temperature**-0.87 * 1e4  # um/s
    critical = 1.01 * temperature**1.55 * 1e-4  # V/um
    beta = 2.57e-2 * temperature**0.66
    return np.asarray(velocity / critical / (1 + (e / critical) ** beta) ** (1 / beta))
