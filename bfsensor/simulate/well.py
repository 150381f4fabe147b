"""The well of a pixel: how much charge it holds before it spills along the column."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.simulate.unit_cell import solve_unit_cell, tile

if TYPE_CHECKING:
    from bfsensor.device.device import Device

_PERIOD = 4
"""Period of the array in which one pixel is filled [pixel]; one more without mirror planes.

Chosen: the images of the full pixel are four pixels away; at eight they would act on its barrier by
less still, at four times the time of a solution."""

_LARGEST_WELL = 2e6
"""Charge above which the search for a full well ends with an error [e-].

Chosen: more than the pixels of science CCDs hold; twice as large changes nothing but how late a
device without an end of its well is refused."""


def barrier(potential: Potential) -> float:
    """Height of the barrier along the column between pixel (0, 0) and its y-neighbour [V].

    The potential of the well less that of the pass to the next one: of all rows between
    the two pixel centres, the one whose highest potential is lowest.

    Parameters
    ----------
    potential : Potential
        Solution on a domain that holds half of pixel (0, 0) and of pixel (0, 1) at least.

    Returns
    -------
    height : float
        Barrier [V]; 0 or less where the well overflows.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> device = Device.load("itl_sta3800c")
    >>> mesh = make_mesh(device, pixels=(2, 2), cells=8)
    >>> empty = tile(solve_unit_cell(device, 0.0, cells=8), mesh)
    >>> bool(barrier(Electrostatics(device, mesh).solve(0.0, start=empty)) > 1.0)
    True
    """
    mesh = potential.mesh
    n_front = potential.silicon.shape[0]
    in_column = np.abs(mesh.x) <= mesh.pitch[0] / 2 + 1e-9
    front = np.where(potential.silicon > 0, potential.phi[:n_front], -np.inf)[
        :, :, in_column
    ]
    highest = front.max(axis=(0, 2))
    own = np.abs(mesh.y) <= mesh.pitch[1] / 2 + 1e-9
    path = (mesh.y >= -1e-9) & (mesh.y <= mesh.pitch[1] + 1e-9)
    return float(highest[own].max() - highest[path].min())


def surface_barrier(potential: Potential) -> float:
    """Height of the barrier that keeps the electrons of pixel (0, 0) off the oxide [V].

    The potential of the well less the highest at the interface of silicon and oxide in the
    same pixel.  Electrons in equilibrium are there less dense than in the middle of the cloud
    by exp(-height / kT): at 0.1 V and 173 K by a factor 1000.

    Parameters
    ----------
    potential : Potential
        Solution on a domain that holds part of pixel (0, 0).

    Returns
    -------
    height : float
        Barrier [V]; 0 where the electrons lie at the interface.
    """
    mesh = potential.mesh
    own_x = np.abs(mesh.x) <= mesh.pitch[0] / 2 + 1e-9
    own_y = np.abs(mesh.y) <= mesh.pitch[1] / 2 + 1e-9
    pixel = np.ix_(np.arange(potential.silicon.shape[0]), own_y, own_x)
    silicon = potential.silicon[pixel] > 0
    front = np.where(silicon, potential.phi[pixel], -np.inf)
    lowest = np.argmax(silicon, axis=0)
    interface = np.take_along_axis(front, lowest[None], axis=0)
    return float(front.max() - interface.max())


def full_well(device: Device, *, cells: int = 16) -> float:
    """Find the charge at which the barrier along the column falls to the spill barrier.

    One pixel is filled and its neighbours are empty, as in a bright star on dark sky.  In a
    device without mirror planes it is the pixel in the middle of a whole period.

    Parameters
    ----------
    device : Device
        Device whose ``well.spill_barrier`` [V] is the barrier at which electrons spill.
    cells : int
        Mesh cells per pixel in x and in y, even, at least 8.

    Returns
    -------
    charge : float
        Full well [e-], to 0.1 %.

    Raises
    ------
    DeviceError
        The empty well is already shallower than the spill barrier.
    ConvergenceError
        The well holds more than 2e6 e-, or a potential does not converge.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> bool(full_well(Device.load("itl_sta3800c"), cells=8) > 1e5)
    True
    """
    mirrored = device.is_mirror_symmetric
    period = _PERIOD if mirrored else _PERIOD + 1
    mesh = make_mesh(device, pixels=(period, period), cells=cells, symmetric=mirrored)
    solver = Electrostatics(device, mesh)
    middle = 0 if mirrored else period // 2
    if mirrored:
        start = tile(solve_unit_cell(device, 0.0, cells=cells), mesh)
    else:
        start = solver.solve(0.0, tolerance=1e-3).phi

    def excess(charge: float) -> float:
        charges = np.zeros(solver.pixel_shape)
        charges[middle, middle] = charge
        return (
            barrier(solver.solve(charges, start=start, tolerance=1e-3))
            - device.well.spill_barrier
        )

    if excess(0.0) <= 0:
        raise DeviceError(
            f"well: spill_barrier = {device.well.spill_barrier:g} V is not below the barrier of "
            f"the empty pixel, {excess(0.0) + device.well.spill_barrier:.3g} V"
        )
    low, high = 0.0, 5e4
    while excess(high) > 0:
        low, high = high, 1.6 * high
        if high > _LARGEST_WELL:
            raise ConvergenceError(
                f"the barrier is still above its spill value at {low:.3g} e-", []
            )
    return float(brentq(excess, low, high, rtol=1e-3))
