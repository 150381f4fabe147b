"""Device of a camera whose covariances are known: what is stated, what stands in, what is fitted."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parts import FittedCharge, Provenance
from bfsensor.fit.camera_fit import CameraFit
from bfsensor.simulate.charge_field import ImageCharge

_LINE = (0.25, 1.0)
"""Heights, over the thickness, through whose fields the straight line of the drift field goes.

Chosen: above the wells, below which the field is not linear; between 0.15 and 0.4 for the first the
line changes by less than 1 % (uniform doping)."""


def stand_in_device(
    template: Device, name: str, settings: Sequence[tuple[str, str]]
) -> Device:
    """Make the device of a camera from another one: stated quantities, and the rest as guesses.

    Where thickness is stated, but not back bias or doping, the template's mean field and voltage of
    full depletion are kept: the back bias is multiplied by the ratio of the thicknesses, the doping
    divided by its square.

    Parameters
    ----------
    template : Device
        Device whose gates, implants, voltages and temperature stand in.
    name : str
        Name of the camera's device.
    settings : sequence of (key, value)
        Quantities that are stated, with units, as for :meth:`Device.with_value`.

    Returns
    -------
    device : Device
        Its quantities that were not stated have the origin 'guessed'.

    Raises
    ------
    DeviceError
        A quantity is not known, or no such device can be built.

    Examples
    --------
    >>> device = stand_in_device(Device.load("itl_sta3800c"), "mine", [("thickness", "200um")])
    >>> device.operating_point.back_bias, device.provenance["gates.gate_oxide"].origin
    (-100.0, 'guessed')
    """
    device = dataclasses.replace(template, image_charge=None)
    stated = {template.unit_of(key)[0] for key, _ in settings}
    for key, value in settings:
        device = device.with_value(key, value)
    ratio = device.silicon.thickness / template.silicon.thickness
    for key, factor in (
        ("operating_point.back_bias", ratio),
        ("silicon.background_doping", ratio**-2),
    ):
        if key not in stated and ratio != 1:
            section, _, field = key.partition(".")
            part = getattr(device, section)
            changed = dataclasses.replace(part, **{field: getattr(part, field) * factor})
            device = dataclasses.replace(device, **{section: changed})
    guessed = Provenance(None, "guessed", f"stands in from {template.name}")
    quantities = [key for key in device.quantities if device.unit_of(key)[1]]
    known = dict.fromkeys((*template.provenance, *quantities), guessed)
    given = Provenance(None, None, "stated with the covariances")
    return dataclasses.replace(
        device, name=name, provenance={**known, **dict.fromkeys(stated, given)}
    )


def states_back_bias(settings: Sequence[tuple[str, str]], device: Device) -> bool:
    """Whether the back bias, and so the mean drift field, is among the stated quantities."""
    return any(device.unit_of(key)[0] == "operating_point.back_bias" for key, _ in settings)


def drift_model(device: Device) -> ImageCharge:
    """Make the model on which a fit begins: the device's size and its drift field as a line.

    Parameters
    ----------
    device : Device
        Fully depleted device.

    Returns
    -------
    base : ImageCharge
        Its heights and half sides are typical ones and are replaced by a fit.
    """
    # Not at the top: the solver's kernels take longer to load than it takes to refuse a file.
    from bfsensor.sensor.drift_field import solve_drift

    text = dataclasses.replace(device, image_charge=None).to_toml()
    drift = solve_drift(text, device.operating_point.temperature, 2.0)
    thickness = device.silicon.thickness
    low, high = np.interp(np.array(_LINE) * thickness, drift.heights, drift.field)
    slope = (high - low) / ((_LINE[1] - _LINE[0]) * thickness)
    return ImageCharge(
        0.5, 1.5, 2.5, device.pixel.pitch_x / 4, device.pixel.pitch_y / 4, thickness,
        device.pixel.pitch_x, device.pixel.pitch_y,
        ((0.0, float(high - slope * thickness)), (thickness, float(high))),
        device.material.permittivity_silicon,
    )  # fmt: skip


def with_fit(device: Device, found: CameraFit) -> Device:
    """Put a fit into the section ``image_charge`` of a device, with errors and sources.

    Parameters
    ----------
    device : Device
        Device of the camera, as for :func:`drift_model`.
    found : CameraFit
        Fit with the base of :func:`drift_model`.

    Returns
    -------
    device : Device
        Device that ``bfsensor table`` takes.
    """
    model, errors = found.model, found.fit.parameter_errors
    assert isinstance(model.drift_field, tuple)
    front, back = (field for _, field in model.drift_field)
    values = {name: getattr(model, name) for name in errors if hasattr(model, name)}
    spreads = {name: errors[name] for name in values}
    for key, field in (("drift_field_front", front), ("drift_field_back", back)):
        values[key], spreads[key] = field, field * found.field_error
    source = f"bfsensor table --from {found.areas.source}; determined by "
    provenance = dict(device.provenance)
    for name in values:
        by = found.determined_by(name if name in found.fit.names else "strength")
        spread = None if np.isnan(spreads[name]) else float(spreads[name])
        provenance[f"image_charge.{name}"] = Provenance(spread, "fitted", source + by)
    part = FittedCharge(**{name: float(value) for name, value in values.items()})
    return dataclasses.replace(device, image_charge=part, provenance=provenance)
