"""Quantities of a device by their dotted names, also those of single implants."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from bfsensor.device.device import Device
from bfsensor.errors import FitError

UNUSED = ("well.spill_barrier",)
"""Uncertain quantities that move no boundary."""


def device_parameters(device: Device) -> dict[str, float]:
    """Quantities of a device whose file states an uncertainty, with it [internal units].

    Parameters
    ----------
    device : Device
        The device.

    Returns
    -------
    uncertainties : dict of str to float
        By dotted name.

    Examples
    --------
    >>> device_parameters(Device.load("itl_sta3800c"))["silicon.thickness"]
    5.0
    """
    return {
        key: float(known.uncertainty)
        for key, known in device.provenance.items()
        if known.uncertainty and key not in UNUSED
    }


def change_parameter(device: Device, key: str, by: float) -> Device:
    """Give a copy with one quantity, also of an implant, changed by so much [internal units].

    Parameters
    ----------
    device : Device
        The device, which stays as it is.
    key : str
        Dotted name, as :func:`device_parameters` gives it.
    by : float
        What is added to the value [internal unit].

    Returns
    -------
    Device
        Without what was known about the old value.

    Raises
    ------
    FitError
        No such quantity.
    """
    try:
        return _changed(device, _steps(device, key), by)
    except (AttributeError, IndexError, TypeError):
        raise FitError(f"no quantity {key!r} in the device {device.name}") from None


def parameter_value(device: Device, key: str) -> float:
    """Give one quantity, also of an implant [internal units].

    Parameters
    ----------
    device : Device
        The device.
    key : str
        Dotted name, as :func:`device_parameters` gives it.

    Returns
    -------
    value : float

    Raises
    ------
    FitError
        No such quantity.

    Examples
    --------
    >>> parameter_value(Device.load("itl_sta3800c"), "silicon.thickness")
    100.0
    """
    part: Any = device
    try:
        for name, n in _steps(device, key):
            part = getattr(part, name if n is None else f"{name}s")
            part = part if n is None else part[n]
        return float(part)
    except (AttributeError, IndexError, TypeError):
        raise FitError(f"no quantity {key!r} in the device {device.name}") from None


def _steps(device: Device, key: str) -> list[tuple[str, int | None]]:
    """Names, and numbers of implants, from the device down to a quantity."""
    steps = [
        (found[1], None if found[2] is None else int(found[2]))
        for found in (
            re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", part) for part in key.split(".")
        )
        if found is not None
    ]
    if len(steps) != len(key.split(".")) or len(steps) < 2 or steps[-1][1] is not None:
        raise FitError(f"no quantity {key!r} in the device {device.name}")
    return steps


def _changed(part: Any, steps: list[tuple[str, int | None]], by: float) -> Any:
    """Copy of a part of a device with the quantity at the end of a path changed."""
    (name, n), *rest = steps
    # Files name one implant, Python the tuple of them.
    field = name if n is None else f"{name}s"
    old = getattr(part, field)
    if n is not None:
        members = list(old)
        members[n] = _changed(members[n], rest, by)
        return dataclasses.replace(part, **{field: tuple(members)})
    new = _changed(old, rest, by) if rest else old + by
    return dataclasses.replace(part, **{field: new})
