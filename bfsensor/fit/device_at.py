"""Copies of a device with fitted parameters, at the condition of a measurement."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.device.parts import ElectronTransport, Provenance
from bfsensor.device.quantities import ABSORPTION, DIFFUSION, Prior, quantities
from bfsensor.errors import BFSensorError, FitError
from bfsensor.typing import FloatArray


def device_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior] = (),
    values: FloatArray | None = None,
) -> Device:
    """Give a device with values of free parameters, and the voltages that a condition states.

    Parameters
    ----------
    device : Device
        Device to copy.
    condition : Condition
        Voltages [V] and temperature [K], which take precedence over ``values``; None in a field:
        the device's own.
    priors : sequence of Prior
        Free parameters.
    values : ndarray, shape (p,), optional
        Their values [internal units]; by default the device's own.

    Returns
    -------
    device : Device
        Changed copy.

    Raises
    ------
    FitError
        No device has these values, such as a gate oxide above the field oxide.

    Examples
    --------
    >>> device = Device.load("itl_sta3800c")
    >>> device_at(device, Condition(back_bias=-60.0)).operating_point.back_bias
    -60.0
    """
    known = quantities(device)
    wanted = {}
    if values is not None:
        wanted = {
            prior.name: float(value) for prior, value in zip(priors, values, strict=True)
        }
    # A device that does not state it has no value of which the difference could be taken.
    width = wanted.pop(DIFFUSION, None)
    wanted.pop(ABSORPTION, None)  # the light's, not the device's
    for key in ("back_bias", "gate_high", "gate_low", "temperature"):
        stated = getattr(condition, key)
        if stated is not None:
            wanted[f"operating_point.{key}"] = float(stated)
    out = device
    left = {name: v for name, v in wanted.items() if v != known[name].value}
    # Some changes are valid only after others, as of two oxides that must stay ordered: retry.
    while left:
        later, refused = {}, None
        for name, value in left.items():
            try:
                out = change_parameter(out, name, value - known[name].value)
            except BFSensorError as error:
                later[name], refused = value, error
        if len(later) == len(left):
            raise FitError(f"no device has these values: {refused}")
        left = later
    if width is not None:
        out = dataclasses.replace(out, transport=ElectronTransport(width))
    return out


def stretch_at(priors: Sequence[Prior], values: FloatArray) -> float:
    """Factor on the absorption length at values of free parameters; 1 where it is not one.

    Examples
    --------
    >>> import numpy as np
    >>> stretch_at([Prior(ABSORPTION, 1.0, 0.1)], np.array([1.07]))
    1.07
    """
    for prior, value in zip(priors, values, strict=True):
        if prior.name == ABSORPTION:
            return float(value)
    return 1.0


def fitted_device(
    device: Device,
    priors: Sequence[Prior],
    values: FloatArray,
    errors: FloatArray,
    source: str,
) -> Device:
    """Give the device with fitted values, their posterior uncertainties, origin and source.

    A device file states uncertainties without their correlations, which only the result of the
    fit holds.

    Parameters
    ----------
    device : Device
        The device that was fitted.
    priors : sequence of Prior
        Priors of the free parameters.
    values, errors : ndarray, shape (p,)
        Fitted values and their posterior errors, in the order of the priors [internal units].
    source : str
        Source that the device file states for these values.

    Returns
    -------
    device : Device
        Named as the device with ``_fitted``.

    Raises
    ------
    FitError
        No device has these values.

    Examples
    --------
    >>> import numpy as np
    >>> prior = Prior("silicon.thickness", 100.0, 5.0)
    >>> device = fitted_device(
    ...     Device.load("itl_sta3800c"), [prior], np.array([98.0]), np.array([2.0]), "an example")
    >>> device.name, device.provenance["silicon.thickness"].uncertainty
    ('itl_sta3800c_fitted', 2.0)
    """
    out = device_at(device, Condition(), priors, values)
    known = dict(out.provenance)
    for prior, error in zip(priors, errors, strict=True):
        if prior.name != ABSORPTION:
            known[prior.name] = Provenance(float(error), "fitted", source)
    return dataclasses.replace(out, name=f"{device.name}_fitted", provenance=known)
