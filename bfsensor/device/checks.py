"""Checks of a device: the range of every quantity, and conditions between its parts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from bfsensor.device.parts import (
    CHOICES,
    LISTS,
    BuriedChannel,
    ChannelStop,
    Edge,
    FittedCharge,
    GateStack,
    Implant,
    OperatingPoint,
    Pixel,
    Silicon,
)
from bfsensor.device.written_units import from_internal
from bfsensor.errors import DeviceError


def check_parts(parts: Mapping[str, Any]) -> None:
    """Refuse parts of which no device can be built.

    Parameters
    ----------
    parts : mapping of str to part
        The sections of a device file by name; None where an optional one is missing.

    Raises
    ------
    DeviceError
        A quantity outside its range, a condition between two parts that does not hold (gates,
        oxides, widths within half a pixel, implants within the silicon), or an implant without
        the keys of its shape; the message names section, key and limit.
    """
    for section, part in parts.items():
        if part is not None:
            _check_part(part, section)
    pixel: Pixel = parts["pixel"]
    silicon: Silicon = parts["silicon"]
    gates: GateStack = parts["gates"]
    channel: BuriedChannel = parts["channel"]
    stop: ChannelStop = parts["channel_stop"]
    point: OperatingPoint = parts["operating_point"]
    edge: Edge | None = parts["edge"]
    if not 2 <= gates.phases <= 8:
        raise DeviceError(f"gates: phases = {gates.phases} must be from 2 to 8")
    if not 1 <= gates.collecting_phases < gates.phases:
        raise DeviceError(
            f"gates: collecting_phases = {gates.collecting_phases} must be from 1 to "
            f"phases - 1 = {gates.phases - 1}"
        )
    if gates.field_oxide < gates.gate_oxide:
        raise DeviceError(
            f"gates: field_oxide = '{gates.field_oxide:g} um' must be at least "
            f"gate_oxide = '{gates.gate_oxide:g} um'"
        )
    room = pixel.pitch_x / 2
    for key, extra in (
        ("field_oxide_taper", gates.field_oxide_taper),
        ("side_diffusion", stop.side_diffusion),
    ):
        if stop.width / 2 + extra >= room:
            raise DeviceError(
                f"channel_stop: width / 2 + {key} = {stop.width / 2 + extra:g} um must be "
                f"below half the pixel, {room:g} um"
            )
    if point.gate_high <= point.gate_low:
        raise DeviceError(
            f"operating_point: gate_high = '{point.gate_high:g} V' must "
            f"be above gate_low = '{point.gate_low:g} V'"
        )
    depth = silicon.thickness - gates.field_oxide
    groups = {
        "channel.implant": channel.implants,
        "channel_stop.implant": stop.implants,
    }
    if stop.dots is not None:
        groups["channel_stop.dots.implant"] = stop.dots.implants
        if stop.dots.height >= pixel.pitch_y or stop.dots.centre > pixel.pitch_y:
            raise DeviceError(
                f"channel_stop.dots: centre = '{stop.dots.centre:g} um' and height = "
                f"'{stop.dots.height:g} um' must lie within the pixel, {pixel.pitch_y:g} um"
            )
    charge: FittedCharge | None = parts["image_charge"]
    if charge is not None:
        _check_charge(charge, pixel, silicon)
    if edge is not None:
        for k, strip in enumerate(edge.strips):
            groups[f"edge.strip[{k}].implant"] = strip.implants
    for where, implants in groups.items():
        for i, implant in enumerate(implants):
            if implant.reach > depth:
                raise DeviceError(
                    f"{where}[{i}]: the implant ends {implant.reach:g} um below the "
                    f"surface, outside the silicon of {depth:g} um"
                )


def _check_charge(charge: FittedCharge, pixel: Pixel, silicon: Silicon) -> None:
    """Check the image-charge model: heights in order, half sides within the pixel."""
    for name in ("row_height", "column_height"):
        value = getattr(charge, name)
        if not charge.charge_height < value < silicon.thickness:
            raise DeviceError(
                f"image_charge: {name} = '{value:g} um' must be above charge_height = "
                f"'{charge.charge_height:g} um' and below thickness = '{silicon.thickness:g} um'"
            )
    for axis in "xy":
        value, pitch = (
            getattr(charge, f"half_width_{axis}"),
            getattr(pixel, f"pitch_{axis}"),
        )
        if value > pitch / 2:
            raise DeviceError(
                f"image_charge: half_width_{axis} = '{value:g} um' must be at most half the "
                f"pixel, {pitch / 2:g} um"
            )


def _check_part(part: Any, where: str) -> None:
    """Check every quantity of a part, and of the parts in it, against its range."""
    for spec in dataclasses.fields(part):
        value = getattr(part, spec.name)
        if value is None:
            continue
        if (type(part), spec.name) in CHOICES:
            choices = CHOICES[type(part), spec.name]
            if value not in choices:
                raise DeviceError(
                    f"{where}: {spec.name} = {value!r} must be one of {', '.join(choices)}"
                )
        elif isinstance(value, tuple):
            entry = LISTS[type(part), spec.name][0]
            for i, item in enumerate(value):
                _check_part(item, f"{where}.{entry}[{i}]")
        elif dataclasses.is_dataclass(value):
            _check_part(value, f"{where}.{spec.name}")
        elif spec.metadata:
            text = (
                from_internal(value, spec.metadata["kind"], spec.metadata["unit"])
                if np.isfinite(value)
                else str(value)
            )
            check_range(value, spec.metadata, where, spec.name, text)
    if isinstance(part, Implant):
        needed = ("peak", "sigma") if part.shape == "gaussian" else ("depth",)
        for name in needed:
            if getattr(part, name) is None:
                raise DeviceError(f"{where}: {name} is missing for a {part.shape} implant")
        for name in sorted({"peak", "sigma", "depth"} - set(needed)):
            if getattr(part, name) is not None:
                raise DeviceError(
                    f"{where}: {name} does not belong to a {part.shape} implant"
                )


def check_range(
    value: float, metadata: Mapping[str, Any], where: str, key: str, given: str
) -> None:
    """Refuse a quantity outside its range.

    Parameters
    ----------
    value : float
        The quantity [internal unit].
    metadata : mapping
        Kind, written unit and range, as fields of :mod:`bfsensor.device.parts` carry them.
    where, key : str
        Section and key, for the message.
    given : str
        The quantity as it was written, for the message.

    Raises
    ------
    DeviceError
        The value is not finite or outside the range.
    """
    kind, unit = metadata["kind"], metadata["unit"]
    low, high = metadata["low"], metadata["high"]

    def limit(number: float) -> str:
        return from_internal(number, kind, unit)

    if not np.isfinite(value):
        raise DeviceError(f"{where}: {key} = {given!r} must be finite")
    if low is not None and (value < low or (metadata["above"] and value <= low)):
        bound = "above" if metadata["above"] else "at least"
        raise DeviceError(f"{where}: {key} = {given!r} must be {bound} {limit(low)}")
    if high is not None and value > high:
        raise DeviceError(f"{where}: {key} = {given!r} must be at most {limit(high)}")
