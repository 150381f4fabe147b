"""The parts of a device: one frozen dataclass for each section of a device file.

Fields read from quantities carry their kind, written unit and range as metadata; values
are floats in internal units (um, V, K, electron/um^3, electron/um^2).  The ranges are checked
when a :class:`~bfsensor.device.device.Device` is made of the parts.
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
    """Uncertainty, origin and source of a value of a device.

    Attributes
    ----------
    uncertainty : float or None
        Standard uncertainty [internal unit], at least 0; None where the file states none.
    origin : str or None
        One of 'measured', 'published', 'fitted', 'guessed'.
    source : str or None
        Where the value comes from, in words.

    Examples
    --------
    >>> Provenance(5.0, "published").origin
    'published'
    """

    uncertainty: float | None = None
    origin: str | None = None
    source: str | None = None


@dataclass(frozen=True)
class Pixel:
    """Pixel pitch.

    Attributes
    ----------
    pitch_x, pitch_y : float
        Pitch along the gates (x, serial) and along the channel stops (y, parallel) [um], above 0
        up to 200.

    Examples
    --------
    >>> Pixel(10.0, 10.0).pitch_x
    10.0
    """

    pitch_x: float = _quantity("length", "um", 0.0, 200.0, above=True)
    pitch_y: float = _quantity("length", "um", 0.0, 200.0, above=True)


@dataclass(frozen=True)
class Material:
    """Constants of silicon and oxide.

    Published devices carry the constants with which they were tuned.

    Attributes
    ----------
    permittivity_silicon, permittivity_oxide : float
        Relative permittivities, 1 to 100.
    band_gap : float
        Band gap of silicon [V], 0.1 to 5.
    density_of_states : float
        Density N_s of :meth:`intrinsic_density` [electron/um^3], above 0.
    thermal_voltage_300K : float or None
        Thermal voltage at 300 K [V], above 0 up to 1, in place of kT/q of CODATA; None: CODATA.

    Examples
    --------
    >>> round(Material().thermal_voltage(300.0), 5)
    0.02585
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
        """Thermal voltage kT/q [V] at a temperature [K]."""
        if self.thermal_voltage_300K is not None:
            return self.thermal_voltage_300K * temperature / 300.0
        return BOLTZMANN * temperature

    def intrinsic_density(self, temperature: float) -> float:
        r"""Intrinsic density [electron/um^3] at a temperature [K].

        :math:`n_i = N_s (T/300)^{3/2} e^{-E_g/2kT}`.  Only its product with the exponential
        of a quasi-Fermi level enters the carriers' densities, so an error of it is a shift of
        that level.
        """
        # kT of CODATA even where thermal_voltage_300K is given: see the shift above.
        kt = BOLTZMANN * temperature
        return float(
            self.density_of_states
            * (temperature / 300.0) ** 1.5
            * np.exp(-self.band_gap / (2 * kt))
        )


@dataclass(frozen=True)
class Ripple:
    """Relative modulation of the background doping, such as tree rings.

    The doping is multiplied by ``1 + amplitude cos(2 pi s / period + phase)``.

    Attributes
    ----------
    kind : {'plane', 'radial'}
        For 'plane' s is the distance along ``direction``, for 'radial' the distance from
        (``centre_x``, ``centre_y``).
    amplitude : float
        Relative amplitude, 0 to 1.
    period : float
        Period [um], above 0.
    phase : float
        Phase at s = 0 [rad].
    direction : float
        Angle from x towards y [rad], used by 'plane' only.
    centre_x, centre_y : float
        Centre of the rings [um], used by 'radial' only.

    Examples
    --------
    >>> float(Ripple("plane", 0.01, 80.0).factor(np.array(40.0), np.array(0.0)))
    0.99
    """

    kind: Literal["plane", "radial"]
    amplitude: float = _quantity("number", "", 0.0, 1.0)
    period: float = _quantity("length", "um", 0.0, None, above=True)
    phase: float = _quantity("angle", "deg", default=0.0)
    direction: float = _quantity("angle", "deg", default=0.0)
    centre_x: float = _quantity("length", "um", default=0.0)
    centre_y: float = _quantity("length", "um", default=0.0)

    def factor(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Background doping at points (x, y) [um], relative to its mean; shape of x and y."""
        if self.kind == "plane":
            s = x * np.cos(self.direction) + y * np.sin(self.direction)
        else:
            s = np.hypot(x - self.centre_x, y - self.centre_y)
        return np.asarray(
            1.0 + self.amplitude * np.cos(2 * np.pi * s / self.period + self.phase)
        )


@dataclass(frozen=True)
class Silicon:
    """The bulk silicon.

    Attributes
    ----------
    thickness : float
        Height of the back surface above the gates' plane z = 0 [um], 5 to 1000.
    background_doping : float
        Doping of the bulk [e/um^3], donors positive, -1e6 to 1e6.
    ripples : tuple of Ripple
        Modulations of that doping; their factors multiply.

    Examples
    --------
    >>> Silicon(thickness=100.0, background_doping=-2.4).ripples
    ()
    """

    thickness: float = _quantity("length", "um", 5.0, 1000.0)
    background_doping: float = _quantity("density", "cm-3", -1e6, 1e6)
    ripples: tuple[Ripple, ...] = ()


@dataclass(frozen=True)
class Implant:
    """Dopants below the silicon surface.

    Attributes
    ----------
    shape : {'gaussian', 'box'}
        A Gaussian in depth, cut at the surface and at peak + 4 sigma as in Poisson_CCD and
        normalised to the dose; or a uniform density down to ``depth``.
    dose : float
        Dopants per area [e/um^2], donors positive, acceptors negative.
    peak, sigma : float or None
        Depth of the maximum, at least 0, and width, above 0 [um]; for 'gaussian', and only there.
    depth : float or None
        Depth [um] down to which the density is uniform, above 0; for 'box', and only there.

    Examples
    --------
    >>> Implant("gaussian", dose=-45000.0, peak=0.5, sigma=0.4).reach
    2.1
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
    """Clock phases and the oxides under them.

    Attributes
    ----------
    phases : int
        Gates a pixel, 2 to 8.
    collecting_phases : int
        Gates a pixel at the high voltage, 1 to ``phases - 1``, centred on the pixel.
    gate_oxide, field_oxide : float
        Thickness of the oxide over the channel and over the channel stop [um], above 0 up to 5;
        the field oxide is at least as thick as the gate oxide.
    field_oxide_taper : float
        Width over which the oxide changes from one to the other [um], 0 to 20.

    Examples
    --------
    >>> GateStack(3, 2, gate_oxide=0.1, field_oxide=0.5).edges_y(9.0)
    (-3.0, 3.0)
    """

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
    """The buried channel.

    Attributes
    ----------
    surface_charge : float
        Fixed charge at the interface of oxide and silicon [e/um^2], positive as donors.
    implants : tuple of Implant
        Implants of the channel; their densities add.

    Examples
    --------
    >>> BuriedChannel(implants=(Implant("box", 9000.0, depth=0.4),)).surface_charge
    0.0
    """

    surface_charge: float = _quantity("dose", "cm-2", default=0.0)
    implants: tuple[Implant, ...] = ()


@dataclass(frozen=True)
class ChannelStopDots:
    """Implants in part of each channel stop, one dot a pixel.

    Attributes
    ----------
    centre : float
        Middle of the dot along y, from the pixel's lower edge [um], 0 up to the pitch.
    height : float
        Length of the dot along y [um], above 0 and below the pitch.
    surface_charge : float
        Fixed charge at the interface within the dot [e/um^2].
    implants : tuple of Implant
        Implants within the dot, beside those of the channel stop.

    Examples
    --------
    >>> ChannelStopDots(centre=5.0, height=3.0).implants
    ()
    """

    centre: float = _quantity("length", "um", 0.0)
    height: float = _quantity("length", "um", 0.0, above=True)
    surface_charge: float = _quantity("dose", "cm-2", default=0.0)
    implants: tuple[Implant, ...] = ()


@dataclass(frozen=True)
class ChannelStop:
    """The channel stop between columns.

    Attributes
    ----------
    width : float
        Width along x, centred on the pixel edge [um], at least 0.
    side_diffusion : float
        Width beyond each side over which its implants fall to 0 [um], at least 0; with half the
        width, and likewise the oxide's taper, less than half the pitch.
    surface_charge : float
        Fixed charge at the interface [e/um^2].
    implants : tuple of Implant
        Implants of the stop, acceptors negative.
    dots : ChannelStopDots or None
        Further implants in part of it.

    Examples
    --------
    >>> ChannelStop(width=2.5).dots is None
    True
    """

    width: float = _quantity("length", "um", 0.0)
    side_diffusion: float = _quantity("length", "um", 0.0, default=0.0)
    surface_charge: float = _quantity("dose", "cm-2", default=0.0)
    implants: tuple[Implant, ...] = ()
    dots: ChannelStopDots | None = None


@dataclass(frozen=True)
class OperatingPoint:
    """Voltages and temperature at which a sensor is operated.

    Attributes
    ----------
    gate_low, gate_high : float
        Voltages of the barrier and of the collecting gates [V], -50 to 50; the second is above
        the first.
    back_bias : float
        Voltage of the back surface [V], -500 to 0.
    temperature : float
        Temperature of the silicon [K], 77 to 350.
    hole_quasi_fermi_level : float
        Quasi-Fermi level of the holes in the channel stops [V], -50 to 50.

    Examples
    --------
    >>> OperatingPoint(-8.0, 2.0, -50.0, 173.0).hole_quasi_fermi_level
    0.0
    """

    gate_low: float = _quantity("potential", "V", -50.0, 50.0)
    gate_high: float = _quantity("potential", "V", -50.0, 50.0)
    back_bias: float = _quantity("potential", "V", -500.0, 0.0)
    temperature: float = _quantity("temperature", "K", 77.0, 350.0)
    hole_quasi_fermi_level: float = _quantity("potential", "V", -50.0, 50.0, default=0.0)


@dataclass(frozen=True)
class Well:
    """The full well of a pixel.

    Attributes
    ----------
    spill_barrier : float
        Height [V] to which the barrier to the next pixel of the column has fallen when charge
        spills, above 0 up to 10.

    Examples
    --------
    >>> Well().spill_barrier
    1.1
    """

    spill_barrier: float = _quantity("potential", "V", 0.0, 10.0, above=True, default=1.1)


@dataclass(frozen=True)
class FittedCharge:
    """The image-charge model of a sensor whose covariances are known, but not its doping.

    Such a device answers by this model (:mod:`bfsensor.simulate.image_charge`); its gates, implants
    and bulk then serve only to solve the drift field, from which diffusion follows.

    Attributes
    ----------
    charge_height : float
        Height of the stored charge above the plane of the gates [um].
    row_height, column_height : float
        Heights [um] below which the boundaries between rows and between columns do not move, above
        that of the charge.
    half_width_x, half_width_y : float
        Half sides of the charged rectangle [um], at most half a pixel.
    drift_field_front, drift_field_back : float
        Drift field at the gates and at the back surface, linear in between [V/um].

    Examples
    --------
    >>> FittedCharge(0.5, 1.4, 3.2, 1.5, 3.0, 0.7, 0.4).column_height
    3.2
    """

    charge_height: float = _quantity("length", "um", 0.0, above=True)
    row_height: float = _quantity("length", "um", 0.0, above=True)
    column_height: float = _quantity("length", "um", 0.0, above=True)
    half_width_x: float = _quantity("length", "um", 0.0, above=True)
    half_width_y: float = _quantity("length", "um", 0.0, above=True)
    drift_field_front: float = _quantity("field", "V/um", 0.0, above=True)
    drift_field_back: float = _quantity("field", "V/um", 0.0, above=True)


@dataclass(frozen=True)
class ElectronTransport:
    """Drift of electrons to the gates, beyond what the electric field determines.

    Attributes
    ----------
    diffusion : float or None
        Width of the diffusion over that by Einstein's relation, 0 to 10; None: not known, and
        Einstein's relation is used.

    Examples
    --------
    >>> ElectronTransport(diffusion=1.92).diffusion
    1.92
    """

    diffusion: float | None = _quantity("number", "", 0.0, 10.0, default=None)


@dataclass(frozen=True)
class EdgeStrip:
    """A strip beyond the last pixel, such as a guard ring.

    Attributes
    ----------
    width : float
        Width [um], above 0.
    voltage : float or None
        Voltage of the strip [V]; None: no electrode, the normal field at its surface is 0.
    oxide : {'none', 'gate', 'field'}
        Oxide behind which the voltage acts; 'none' is a contact at the silicon itself.
    implants : tuple of Implant
        Implants below its surface.

    Examples
    --------
    >>> EdgeStrip(width=20.0, voltage=0.0, oxide="none").implants
    ()
    """

    width: float = _quantity("length", "um", 0.0, above=True)
    voltage: float | None = _quantity("potential", "V", default=None)
    oxide: Literal["none", "gate", "field"] = "field"
    implants: tuple[Implant, ...] = ()


@dataclass(frozen=True)
class Edge:
    """The strips beyond the last pixel.

    Attributes
    ----------
    side : {'x', 'y'}
        Axis along which one leaves the array: 'x' has the strips beside the last column.
    strips : tuple of EdgeStrip
        The strips, the one next to the array first.

    Examples
    --------
    >>> Edge("x", (EdgeStrip(20.0),)).strips[0].oxide
    'field'
    """

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
    "transport": ElectronTransport,
    "edge": Edge,
    "image_charge": FittedCharge,
}
"""Type of each section of a device file, in the order in which files are written."""
