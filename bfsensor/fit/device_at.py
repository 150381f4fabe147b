"""Devices at other conditions and with other parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.device.parts import Provenance
from bfsensor.device.quantities import DIFFUSION, Prior, quantities
from bfsensor.errors import BFSensorError, FitError
from bfsensor.typing import FloatArray


def device_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior] = (),
    values: FloatArray | None = None,
) -> Device:
    """Give the device with parameters of the fit, and then as a condition states.

    Parameters
    ----------
    device : Device
        As its file says.
    condition : Condition
        Voltages and temperature; None: the device's own.
    priors, values
        Free parameters and what they are [internal units].

    Raises
    ------
    FitError
        There is no such device.
    """
    known = quantities(device)
    wanted = {}
    if values is not None:
        wanted = {
            prior.name: float(value)
            for prior, value in zip(priors, values, strict=True)
            if prior.name != DIFFUSION
        }
    for key in ("back_bias", "gate_high", "gate_low", "temperature"):
        stated = getattr(condition, key)
        if stated is not None:
            wanted[f"operating_point.{key}"] = float(stated)
    out = device
    left = {name: v for name, v in wanted.items() if v != known[name].value}
    # What needs another change first, such as thicker oxides, waits for it.
    while left:
        later, refused = {}, None
        for name, value in left.items():
            try:
                out = change_parameter(out, name, value - known[name].value)
            except BFSensorError as error:
                later[name], refused = value, error
        if len(later) == len(left):
            raise FitError(f"no such device: {refused}")
        left = later
    return out


def fitted_device(
    device: Device,
    priors: Sequence[Prior],
    values: FloatArray,
    errors: FloatArray,
    source: str,
) -> Device:
    """Give the device with fitted values, their posterior uncertainties, origin and source.

    Uncertainties stand alone in a device file: what of them parameters share is in the result of
    the fit only.

    Parameters
    ----------
    device : Device
        The device that was fitted.
    priors : sequence of Prior
        Of the free parameters.
    values, errors : ndarray
        Of the same parameters, in their order [internal units].
    source : str
        What the device file says of where the values come from.

    Returns
    -------
    Device
    """
    out = device_at(device, Condition(), priors, values)
    known = dict(out.provenance)
    for prior, error in zip(priors, errors, strict=True):
        if prior.name != DIFFUSION:
            known[prior.name] = Provenance(float(error), "fitted", source)
    return dataclasses.replace(out, name=f"{device.name}_fitted", provenance=known)
