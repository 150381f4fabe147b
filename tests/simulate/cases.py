"""Devices whose potentials are known, and fields, for the tests of the simulator."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.device.device import Device
from bfsensor.device.parts import BuriedChannel, ChannelStop, GateStack, Implant
from bfsensor.simulate.charge_field import (
    TOLERANCE,
    ImageCharge,
    farthest,
    image_series,
    sum_field,
)
from bfsensor.typing import FloatArray


def charge_field(
    model: ImageCharge, points: ArrayLike, *, tolerance: float = TOLERANCE
) -> FloatArray:
    """Field of one stored electron at points (..., 3), from the series that reaches them."""
    at = np.asarray(points, float)
    flat = np.ascontiguousarray(at.reshape(-1, 3))
    series = image_series(model, farthest(flat[:, :2], model), tolerance)
    return sum_field(model, flat, series).reshape(at.shape)


def flat_device(
    *,
    implants: tuple[Implant, ...] = (),
    surface_charge: float = 0.0,
    same_permittivity: bool = False,
) -> Device:
    """A capacitor: flat oxide, one gate voltage, depleted silicon, no carriers."""
    device = Device.load("e2v_ccd250")
    material = device.material
    if same_permittivity:
        material = dataclasses.replace(
            material, permittivity_oxide=material.permittivity_silicon
        )
    return dataclasses.replace(
        device,
        name="flat",
        material=material,
        channel=BuriedChannel(surface_charge, implants),
        channel_stop=ChannelStop(0.0),
        gates=GateStack(4, 2, 0.15, 0.15),
        operating_point=dataclasses.replace(
            device.operating_point,
            gate_low=3.0 - 1e-9,
            gate_high=3.0,
            hole_quasi_fermi_level=-49.0,
        ),
        provenance={},
    )
