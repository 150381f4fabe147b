"""The parts of a device: one frozen record for each section of a device file.

Fields read from quantities carry their kind, written unit and range as metadata; values
are floats in internal units (um, V, K, electron/um^3, electron/um^2).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.special import erf

from bfsensor.typing import FloatArray
from bfsensor.units import BOLTZMANN


def _quantity(
    kind: str,
    unit: str,
    low: float | None = None,
    high: float | None = None,
    *,
    above: bool = False,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Make a field read from a quantity: its kind, the unit it is written in, its range."""
    metadata = {"kind": kind, "unit": unit, "low": low, "high": high, "above": above}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Provenance:
    """What is known about a value: its uncertainty (internal unit), origin and source."""

    uncertainty: float | None = None
    origin: str | None = None
    source: str | None = None


@dataclass(frozen=True)
class Pixel:
    """Pixel pitch along the gates (x) and along the channel stops (y) [um]."""

    pitch_x: float = _quantity("length", "um", 0.0, 200.0, above=True)
    pitch_y: float = _quantity("length", "um", 0.0, 200.0, above=True)


@dataclass(frozen=True)
class Material:
    """Constants of silicon and oxide; published devices carry those they were tuned with.

    ``thermal_voltage_300K`` [V], where given, replaces kT/q of CODATA.
    """

    permittivity_silicon: float = _quantity("number", "", 1.0, 100.0, default=11.7)
    permittivity_oxide: float = _quantity("number", "", 1.0, 100.0, default=3.9)
    band_gap: float = _quantity("potential", "V", 0.1, 5.0, default=1.12)
    density_of_states: float = _quantity(
        "density", "cm-3", 0.0, None, above=True, default=2.5e7
    )
    thermal_voltage_300K: float | None = _quantity(  # noqa: N815
        "potential", "V", 0.0, 1.0, above=True, default=None
    )

    def thermal_voltage(self, temperature: float) -> float:
        """Thermal voltage kT/q [V] at ``temperature`` [K]."""
        if self.thermal_voltage_300K is not None:
            return self.thermal_voltage_300K * temperature / 300.0
        return BOLTZMANN * temperature

    def intrinsic_density(self, temperature: float) -> float:
        r"""Intrinsic density [electron/um^3] at ``temperature`` [K].

        :math:`n_i = N_s (T/300)^{3/2} e^{-E_g/2kT}`; only its product with the exponential
        of a quasi-Fermi level matters, so its error is a shift of that level.
        """
        kt = BOLTZMANN * temperature
        return float(
            self.density_of_states
            * (temperature / 300.0) ** 1.5
            * np.exp(-self.band_gap / (2 * kt))
        )


@dataclass(frozen=True)
class Ripple:
    """Relative modulation of the background doping (tree rings).

    ``kind`` 'plane': cos(2 pi s / period + phase) with s along ``direction`` from x;
    'radial': s is the distance from (``centre_x``, ``centre_y``) [um].
    """

    kind: Literal["plane", "radial"]
    amplitude: float = _quantity("number", "", 0.0, 1.0)
    period: float = _quantity("length", "um", 0.0, None, above=True)
    phase: float = _quantity("angle", "deg", default=0.0)
    direction: float = _quantity("angle", "deg", default=0.0)
    centre_x: float = _quantity("length", "um", default=0.0)
    centre_y: float = _quantity("length", "um", default=0.0)

    def factor(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Relative doping at points (x, y) [um]."""
        if self.kind == "plane":
            s = x * np.cos(self.direction) + y * np.sin(self.direction)
        else:
            s = np.hypot(x - self.centre_x, y - self.centre_y)
        return np.asarray(
            1.0 + self.amplitude * np.cos(2 * np.pi * s / self.period + self.phase)
        )


@dataclass(frozen=True)
class Silicon:
    """Thickness [um], background doping [e/um^3] and its ripples."""

    thickness: float = _quantity("length", "um", 5.0, 1000.0)
    background_doping: float = _quantity("density", "cm-3", -1e6, 1e6)
    ripples: tuple[Ripple, ...] = ()


@dataclass(frozen=True)
class Implant:
    """Dopants below the silicon surface: ``dose`` [e/um^2], donors positive.

    'gaussian': peak depth and sigma [um], cut at the surface and at peak + 4 sigma as in
    the published model, and normalised to the dose; 'box': uniform down to ``depth`` [um].
    """

    shape: Literal["gaussian", "box"]
    dose: float = _quantity("dose", "cm-2")
    peak: float | None = _quantity("length", "um", 0.0, default=None)
    sigma: float | None = _quantity("length", "um", 0.0, above=True, default=None)
    depth: float | None = _quantity("length", "um", 0.0, above=True, default=None)

    @property
    def reach(self) -> float:
        """Depth below the surface [um] where the implant ends."""
        if self.shape == "box":
            return float(self.depth or 0.0)
        return float((self.peak or 0.0) + 4.0 * (self.sigma or 0.0))

    def cumulative(self, depth: FloatArray) -> FloatArray:
        """Dose [e/um^2] between the surface and ``depth`` [um] below it."""
        depth = np.clip(depth, 0.0, self.reach)
        if self.shape == "box":
            return np.asarray(self.dose * depth / self.reach)
        assert self.peak is not None  # checked with the device
        assert self.sigma is not None
        scale = np.sqrt(2.0) * self.sigma
        start, end = erf(-self.peak / scale), erf((self.reach - self.peak) / scale)
        return np.asarray(
            self.dose * (erf((depth - self.peak) / scale) - start) / (end - start)
        )

    def density(self, depth: FloatArray) -> FloatArray:
        """Density [e/um^3] at ``depth`` [um] below the surface."""
        depth = np.asarray(depth, float)
        inside = (depth >= 0) & (depth <= self.reach)
        if self.shape == "box":
            return np.where(inside, self.dose / self.reach, 0.0)
        assert self.peak is not None  # checked with the device
        assert self.sigma is not None
        scale = np.sqrt(2.0) * self.sigma
        norm = 0.5 * (erf((self.reach - self.peak) / scale) - erf(-self.peak / scale))
        shape = np.exp(-0.5 * ((depth - self.peak) / self.sigma) ** 2) / (
            np.sqrt(2 * np.pi) * self.sigma
        )
        return np.where(inside, self.dose * shape / norm, 0.0)


@dataclass(frozen=True)
class GateStack:
    """Clock phases and the oxides under them [um]."""

    phases: int
    collecting_phases: int
    gate_oxide: float = _quantity("length", "um", 0.0, 5.0, above=True)
    field_oxide: float = _quantity("length", "um", 0.0, 5.0, above=True)
    field_oxide_taper: float = _quantity("length", "um", 0.0, 20.0, default=0.0)

    def edges_y(self, pitch_y: float) -> tuple[float, float]:
        """Edges of the collecting gates relative to the pixel centre [um]."""
        half = 0.5 * pitch_y * self.collecting_phases / self.phases
        return -half, half


@dataclass(frozen=True)
class BuriedChannel:
    """The buried channel: implants, and charge at the oxide interface [e/um^2]."""

    surface_charge: float = _quantity("dose", "cm-2", default=0.0)
    implants: tuple[Implant, ...] = ()


@dataclass(frozen=True)
class ChannelStopDots:
    """Implants in part of each channel stop: centre above the pixel's edge, height [um]."""

    centre: float = _quantity("length", "um", 0.0)
    height: float = _quantity("length", "um", 0.0, above=True)
    surface_charge: float = _quantity("dose", "cm-2", default=0.0)
    implants: tuple[Implant, ...] = ()


@dataclass(frozen=True)
class ChannelStop:
    """The stop between columns: width centred on the pixel edge, side diffusion [um]."""

    width: float = _quantity("length", "um", 0.0)
    side_diffusion: float = _quantity("length", "um", 0.0, default=0.0)
    surface_charge: float = _quantity("dose", "cm-2", default=0.0)
    implants: tuple[Implant, ...] = ()
    dots: ChannelStopDots | None = None


@dataclass(frozen=True)
class OperatingPoint:
    """Voltages [V] and temperature [K]."""

    gate_low: float = _quantity("potential", "V", -50.0, 50.0)
    gate_high: float = _quantity("potential", "V", -50.0, 50.0)
    back_bias: float = _quantity("potential", "V", -500.0, 0.0)
    temperature: float = _quantity("temperature", "K", 77.0, 350.0)
    hole_quasi_fermi_level: float = _quantity("potential", "V", -50.0, 50.0, default=0.0)


@dataclass(frozen=True)
class Well:
    """Barrier along the column [V] at which charge spills."""

    spill_barrier: float = _quantity("potential", "V", 0.0, 10.0, above=True, default=1.1)


@dataclass(frozen=True)
class EdgeStrip:
    """A strip beyond the last pixel: at a voltage [V], or field-free where that is None.

    A voltage acts behind the gate or field oxide, or at the silicon itself ('none': a contact).
    Nothing holds the surface of a field-free strip.
    """

    width: float = _quantity("length", "um", 0.0, above=True)
    voltage: float | None = _quantity("potential", "V", default=None)
    oxide: Literal["none", "gate", "field"] = "field"
    implants: tuple[Implant, ...] = ()


@dataclass(frozen=True)
class Edge:
    """Strips (a guard ring) beyond the last pixel, along x or y, innermost first."""

    side: Literal["x", "y"]
    strips: tuple[EdgeStrip, ...] = ()


CHOICES: dict[tuple[type, str], tuple[str, ...]] = {
    (Ripple, "kind"): ("plane", "radial"),
    (Implant, "shape"): ("gaussian", "box"),
    (EdgeStrip, "oxide"): ("none", "gate", "field"),
    (Edge, "side"): ("x", "y"),
}
"""Words that a key of a part may have, by part and key."""

LISTS: dict[tuple[type, str], tuple[str, type]] = {
    (Silicon, "ripples"): ("ripple", Ripple),
    (BuriedChannel, "implants"): ("implant", Implant),
    (ChannelStop, "implants"): ("implant", Implant),
    (ChannelStopDots, "implants"): ("implant", Implant),
    (EdgeStrip, "implants"): ("implant", Implant),
    (Edge, "strips"): ("strip", EdgeStrip),
}
"""Name of one entry in device files and its type, by the part and field that hold the tuple."""

SECTIONS: dict[str, type] = {
    "pixel": Pixel,
    "material": Material,
    "silicon": Silicon,
    "gates": GateStack,
    "channel": BuriedChannel,
    "channel_stop": ChannelStop,
    "operating_point": OperatingPoint,
    "well": Well,
    "edge": Edge,
}
"""Type of each section of a device file, in the order in which files are written."""
