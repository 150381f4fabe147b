"""Quantities of a device by dotted name, those of single implants included: read, change, list."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from bfsensor.device.device import Device
from bfsensor.errors import FitError

UNUSED = ("well.spill_barrier", "transport.diffusion")
"""Quantities whose uncertainty moves no pixel boundary; they are not among the parameters."""


def device_parameters(device: Device) -> dict[str, float]:
    """List the quantities of a device whose file states an uncertainty above 0.

    Parameters
    ----------
    device : Device
        Any.

    Returns
    -------
    uncertainties : dict of str to float
        Standard uncertainties [internal unit] by dotted name, without :data:`UNUSED`.

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
    """Return a copy with a difference added to one quantity.

    Parameters
    ----------
    device : Device
        Any.
    key : str
        Dotted name, as :func:`device_parameters` gives it, also of a quantity of an implant,
        such as ``'channel.implant[0].dose'``.
    by : float
        Difference that is added [internal unit].

    Returns
    -------
    Device
        Changed copy; its provenance is that of ``device``, the changed quantity's included.

    Raises
    ------
    FitError
        No such quantity.
    DeviceError
        The changed value is outside its range.

    Examples
    --------
    >>> thicker = change_parameter(Device.load("itl_sta3800c"), "silicon.thickness", 2.5)
    >>> thicker.silicon.thickness
    102.5
    """
    try:
        return _changed(device, _steps(device, key), by)
    except (AttributeError, IndexError, TypeError):
        raise FitError(f"no quantity {key!r} in the device {device.name}") from None


def parameter_value(device: Device, key: str) -> float:
    """Return the value of one quantity.

    Parameters
    ----------
    device : Device
        Any.
    key : str
        Dotted name, as :func:`device_parameters` gives it, also of a quantity of an implant.

    Returns
    -------
    value : float
        The quantity [internal unit].

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
    """Split a dotted name into names, each with its index where one stands in brackets."""
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
    """Copy of a part of a device with ``by`` added to the quantity at the end of a path."""
    (name, n), *rest = steps
    # A file's key names one implant, the Python field the tuple of all.
    field = name if n is None else f"{name}s"
    old = getattr(part, field)
    if n is not None:
        members = list(old)
        members[n] = _changed(members[n], rest, by)
        return dataclasses.replace(part, **{field: tuple(members)})
    new = _changed(old, rest, by) if rest else old + by
    return dataclasses.replace(part, **{field: new})
