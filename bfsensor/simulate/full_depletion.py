"""Full-depletion voltage of a device, solved: the back bias at which the field at its back vanishes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bfsensor.device.depletion import find_depletion
from bfsensor.errors import ConvergenceError
from bfsensor.simulate.unit_cell import solve_unit_cell
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device.device import Device

_BEYOND = 3.0, 1.5
"""Distances below the estimate at which the root search begins [V].

Chosen: the estimate (:func:`~bfsensor.device.depletion.find_depletion`) is within 1 V, so that both
points are depleted; twice as far the search takes one step more."""

_MOST = 6
"""Largest number of secants.

Chosen: the field is nearly linear in the bias, so that two or three do; twice as many change nothing."""

_ERROR = 1e-4
"""Field at the back that counts as none [V/um].  Derived: 0.01 V of the bias in 100 um of silicon."""


def back_field(device: Device, charge: float = 0.0, *, cells: int = 16) -> float:
    """Solve one pixel of a uniform array for the slope of its potential at the back contact.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    charge : float
        Electrons in every pixel [e-], 0 or more.
    cells : int
        Mesh cells per pixel, even, at least 8.

    Returns
    -------
    slope : float
        Mean slope of the potential along z at the back [V/um], below 0 where the silicon is depleted.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> back_field(Device.load("itl_sta3800c"), cells=8) < 0
    True
    """
    unit = solve_unit_cell(device, charge, cells=cells)
    weights = []
    for nodes in (unit.mesh.y, unit.mesh.x):
        gaps = np.diff(nodes)
        weights.append(np.concatenate([gaps, [0.0]]) + np.concatenate([[0.0], gaps]))
    area = np.outer(*weights)
    below, at = np.tensordot(unit.phi[-2:], area, 2) / area.sum()
    step = unit.mesh.z[-1] - unit.mesh.z[-2]
    # The doping makes the potential a parabola: its slope at the back differs by this much from
    # the slope between the last two nodes.
    permittivity = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    half = 0.5 * step * device.silicon.background_doping / permittivity
    return float((at - below) / step - half)


def full_depletion_voltage(
    device: Device, charge: float = 0.0, *, cells: int = 16
) -> float:
    """Find the back bias at and below which all of the silicon is depleted.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device; its own back bias does not matter.
    charge : float
        Electrons in every pixel [e-], 0 or more.
    cells : int
        Mesh cells per pixel, even, at least 8.

    Returns
    -------
    voltage : float
        Back bias [V], signed as in device files, to 0.01 V in 100 um of silicon.

    Raises
    ------
    ConvergenceError
        The field at the back does not vanish at any bias near the estimate.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> bool(-16 < full_depletion_voltage(Device.load("e2v_ccd250"), cells=8) < -12)
    True
    """

    def slope(bias: float) -> float:
        return back_field(
            device.with_value("back_bias", f"{bias!r} V"), charge, cells=cells
        )

    estimate = find_depletion(device).full_depletion_voltage
    low, high = (estimate - away for away in _BEYOND)
    left, right = slope(low), slope(high)
    for _ in range(_MOST):
        if abs(right) < _ERROR:
            return float(high)
        low, high, left = high, high - right * (high - low) / (right - left), right
        right = slope(high)
    raise ConvergenceError(
        f"{device.name}: the field at the back does not vanish near {estimate:.3g} V", []
    )
