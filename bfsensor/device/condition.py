"""Condition of an exposure: wavelength or filter, sensor temperature, voltages and level."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Condition:
    """Light and operating point that exposures share.

    None stands for a value that is not known; predictions then take the device's own.

    Attributes
    ----------
    wavelength : float or None
        Vacuum wavelength of the light [nm].
    filter : str or None
        Name of the filter.
    temperature : float or None
        Temperature of the sensor [K].
    back_bias : float or None
        Back bias [V], signed as in device files.
    gate_high, gate_low : float or None
        Voltages of the collecting and of the barrier gates [V].
    level : float or None
        Charge in every pixel about which a response was measured [e-]; 0 for the a_ij of a fit to
        covariances at several levels, which are the limit at none.

    Examples
    --------
    >>> print(Condition(wavelength=620.0, back_bias=-50.0))
    620 nm, back bias -50 V
    """

    wavelength: float | None = None
    filter: str | None = None
    temperature: float | None = None
    back_bias: float | None = None
    gate_high: float | None = None
    gate_low: float | None = None
    level: float | None = None

    def __str__(self) -> str:
        words = []
        if self.wavelength is not None:
            words.append(f"{self.wavelength:g} nm")
        elif self.filter:
            words.append(self.filter)
        if self.back_bias is not None:
            words.append(f"back bias {self.back_bias:g} V")
        if self.gate_high is not None and self.gate_low is not None:
            words.append(f"gates {self.gate_low:g}/{self.gate_high:g} V")
        if self.temperature is not None:
            words.append(f"{self.temperature:.4g} K")
        if self.level is not None:
            words.append(f"level {self.level:g} e-")
        return ", ".join(words) or "not known"
