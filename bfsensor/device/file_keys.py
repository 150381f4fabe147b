"""Keys of device files: what each means, its unit, range and default, as the reader has them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from bfsensor.device.parts import (
    CHOICES,
    LISTS,
    SECTIONS,
    BuriedChannel,
    ChannelStop,
    ChannelStopDots,
    Edge,
    EdgeStrip,
    ElectronTransport,
    FittedCharge,
    GateStack,
    Implant,
    Material,
    OperatingPoint,
    Pixel,
    Ripple,
    Silicon,
    Well,
)
from bfsensor.device.written_units import from_internal

MEANINGS: dict[tuple[type, str], str] = {
    (Pixel, "pitch_x"): "Pixel pitch along the gates, in the direction of rows.",
    (Pixel, "pitch_y"): "Pixel pitch along the channel stops, in the direction of columns.",
    (Material, "permittivity_silicon"): "Relative permittivity of silicon.",
    (Material, "permittivity_oxide"): "Relative permittivity of the oxides.",
    (Material, "band_gap"): "Band gap of silicon over the elementary charge.",
    (Material, "density_of_states"): "Effective density of states of silicon at 300 K.",
    (Material, "thermal_voltage_300K"): (
        "Thermal voltage kT/q at 300 K that replaces the one from CODATA's constants."
    ),
    (
        Silicon,
        "thickness",
    ): "Height of the back surface above the gates; light enters there.",
    (Silicon, "background_doping"): (
        "Net density of dopants in the bulk: donors positive, acceptors negative."
    ),
    (Silicon, "ripples"): "Relative modulations of the background doping (tree rings).",
    (Ripple, "kind"): "Shape of the modulation: plane waves, or rings around a centre.",
    (Ripple, "amplitude"): "Amplitude of the modulation over the background doping.",
    (Ripple, "period"): "Period of the modulation.",
    (
        Ripple,
        "phase",
    ): "Phase of the modulation at the origin, or at the centre of the rings.",
    (Ripple, "direction"): "Direction of plane waves, from x towards y.",
    (Ripple, "centre_x"): "Centre of the rings in x.",
    (Ripple, "centre_y"): "Centre of the rings in y.",
    (GateStack, "phases"): "Number of clock phases (gates) of a pixel: from 2 to 8.",
    (GateStack, "collecting_phases"): (
        "Number of adjacent gates held high during integration: from 1 to phases - 1."
    ),
    (GateStack, "gate_oxide"): "Thickness of the oxide under the gates.",
    (GateStack, "field_oxide"): (
        "Thickness of the oxide over the channel stops, at least that of the gate oxide."
    ),
    (GateStack, "field_oxide_taper"): (
        "Width over which the oxide grows from gate oxide to field oxide, on either side of "
        "the channel stop."
    ),
    (
        BuriedChannel,
        "surface_charge",
    ): "Fixed charge at the interface of silicon and oxide.",
    (BuriedChannel, "implants"): "Implants of the buried channel.",
    (ChannelStop, "width"): "Width of the channel stop, centred on the edge of the pixel.",
    (ChannelStop, "side_diffusion"): (
        "Distance over which the implants of the stop fall off sideways."
    ),
    (ChannelStop, "surface_charge"): "Fixed charge at the interface over the channel stop.",
    (ChannelStop, "implants"): "Implants of the channel stop.",
    (ChannelStop, "dots"): "Implants in a part of each channel stop.",
    (ChannelStopDots, "centre"): "Centre of the part in y, above the edge of the pixel.",
    (ChannelStopDots, "height"): "Extent of the part in y, below the pixel pitch.",
    (ChannelStopDots, "surface_charge"): "Fixed charge at the interface over the part.",
    (ChannelStopDots, "implants"): "Implants of the part.",
    (Implant, "shape"): "Profile of the implant in depth.",
    (Implant, "dose"): "Dopants per area: donors positive, acceptors negative.",
    (Implant, "peak"): (
        "Depth of the peak below the surface; a gaussian implant needs it, a box refuses it."
    ),
    (Implant, "sigma"): (
        "Standard deviation in depth; a gaussian implant needs it, a box refuses it."
    ),
    (Implant, "depth"): (
        "Depth to which a box implant is uniform; a box needs it, a gaussian refuses it."
    ),
    (OperatingPoint, "gate_low"): "Voltage of the barrier gates.",
    (
        OperatingPoint,
        "gate_high",
    ): "Voltage of the collecting gates, above that of the barriers.",
    (OperatingPoint, "back_bias"): "Voltage of the back contact.",
    (OperatingPoint, "temperature"): "Temperature of the silicon.",
    (OperatingPoint, "hole_quasi_fermi_level"): "Quasi-Fermi potential of the free holes.",
    (Well, "spill_barrier"): (
        "Barrier along the column that is left when stored charge spills to the next pixel."
    ),
    (ElectronTransport, "diffusion"): (
        "Width of the diffusion over that by Einstein's relation, which holds where it is missing."
    ),
    (Edge, "side"): "Direction in which the strips follow the last pixel.",
    (Edge, "strips"): "Strips beyond the last pixel, the innermost first.",
    (EdgeStrip, "width"): "Width of the strip.",
    (EdgeStrip, "voltage"): "Voltage of the strip; without it the strip is free of field.",
    (EdgeStrip, "oxide"): (
        "Oxide between the voltage and the silicon; with 'none' the strip is a contact."
    ),
    (EdgeStrip, "implants"): "Implants below the strip.",
    (FittedCharge, "charge_height"): "Height of the stored charge above the gates.",
    (FittedCharge, "row_height"): (
        "Height below which boundaries between rows do not move, above that of the charge."
    ),
    (FittedCharge, "column_height"): (
        "Height below which boundaries between columns do not move, above that of the charge."
    ),
    (FittedCharge, "half_width_x"): (
        "Half side of the charged rectangle in x, at most half the pixel."
    ),
    (FittedCharge, "half_width_y"): (
        "Half side of the charged rectangle in y, at most half the pixel."
    ),
    (FittedCharge, "drift_field_front"): "Drift field at the gates.",
    (FittedCharge, "drift_field_back"): (
        "Drift field at the back surface; it is linear in between."
    ),
}
"""Meaning of each entry, by the part of a device that keeps it."""

SECTION_MEANINGS = {
    "pixel": "The pitch of the pixels.",
    "material": "Constants of silicon and oxide.",
    "silicon": "The bulk of the sensor.",
    "gates": "Clock phases and the oxides under them.",
    "channel": "The buried channel.",
    "channel_stop": "The stop between two columns.",
    "operating_point": "Voltages and temperature.",
    "well": "The charge that a pixel holds.",
    "transport": "How electrons drift to the gates; no solution depends on it.",
    "edge": "The sensor beyond its last pixel, for solutions of edges only.",
    "image_charge": (
        "A model fitted to covariances, which `bfsensor table` then takes instead of solving."
    ),
}
"""Meaning of each section."""


@dataclass(frozen=True)
class DeviceKey:
    """One entry of a device file.

    Attributes
    ----------
    section : str
        Section that holds it, as in ``[channel_stop]`` or ``[[channel.implant]]``.
    key : str
        Its name there.
    unit : str
        Unit in which the package writes it; any unit of the same dimension is read.
    default : str
        Value that holds where the entry is missing; 'required' where there is none, 'none'
        where its absence has a meaning of its own.
    allowed : str
        Range or words that are accepted.
    meaning : str
        What it describes.
    """

    section: str
    key: str
    unit: str
    default: str
    allowed: str
    meaning: str


def device_keys() -> tuple[DeviceKey, ...]:
    """List every entry that a device file may have, in the order of the sections.

    Returns
    -------
    keys : tuple of DeviceKey

    Examples
    --------
    >>> keys = {(k.section, k.key): k for k in device_keys()}
    >>> keys["[silicon]", "thickness"].allowed
    '5 um to 1000 um'
    """
    return tuple(
        key
        for section, kind in SECTIONS.items()
        for key in _keys_of(kind, f"[{section}]", section)
    )


def _keys_of(kind: type, section: str, path: str) -> Iterator[DeviceKey]:
    """Entries of one part, and of the parts inside it."""
    inside: list[tuple[type, str, str]] = []
    for spec in dataclasses.fields(kind):
        meaning = MEANINGS[kind, spec.name]
        unit, allowed = spec.metadata.get("unit", ""), ""
        key = spec.name
        if (kind, spec.name) in LISTS:
            key, element = LISTS[kind, spec.name]
            allowed = f"sections [[{path}.{key}]]"
            inside.append((element, f"[[{path}.{key}]]", f"{path}.{key}"))
        elif (kind, spec.name) in CHOICES:
            allowed = ", ".join(f"'{word}'" for word in CHOICES[kind, spec.name])
        elif spec.name == "dots":
            allowed = f"a section [{path}.dots]"
            inside.append((ChannelStopDots, f"[{path}.dots]", f"{path}.dots"))
        elif spec.metadata:
            allowed = _range_of(spec.metadata)
        else:
            allowed = "whole number"
        yield DeviceKey(section, key, unit, _default_of(spec), allowed, meaning)
    for element, header, inner in inside:
        yield from _keys_of(element, header, inner)


def _default_of(spec: dataclasses.Field[Any]) -> str:
    """Default of an entry as a device file would write it."""
    if spec.default is dataclasses.MISSING:
        return "required"
    if spec.default is None or spec.default == ():
        return "none"
    if spec.metadata:
        return from_internal(spec.default, spec.metadata["kind"], spec.metadata["unit"])
    return f"'{spec.default}'"


def _range_of(metadata: Any) -> str:
    """Range of a quantity in words, in the unit that the package writes."""
    kind, unit = metadata["kind"], metadata["unit"]
    low, high = (
        None if end is None else from_internal(end, kind, unit)
        for end in (metadata["low"], metadata["high"])
    )
    if low is None:
        return "any" if high is None else f"at most {high}"
    start = f"above {low}" if metadata["above"] else low
    if high is None:
        return start if metadata["above"] else f"at least {low}"
    return f"{start} to {high}"
