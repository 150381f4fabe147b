"""Conditions that exposures are taken under: light, temperature, voltages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Condition:
    """Light and operating point that exposures share; None where not known, or the device's own.

    Attributes
    ----------
    wavelength : float or None
        Of the light [nm].
    temperature : float or None
        Of the sensor [K].
    back_bias, gate_high, gate_low : float or None
        Back bias, collecting and barrier gates [V].
    filter : str or None
        Name of a filter.
    """

    wavelength: float | None = None
    filter: str | None = None
    temperature: float | None = None
    back_bias: float | None = None
    gate_high: float | None = None
    gate_low: float | None = None

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
        return ", ".join(words) or "not known"
