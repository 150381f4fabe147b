"""Error of the layer of free holes at the surface, which is thinner than a cell of the mesh."""

from __future__ import annotations

import numpy as np

from bfsensor.simulate.discretise import dual_widths
from bfsensor.simulate.poisson import Potential
from bfsensor.units import VACUUM_PERMITTIVITY

FULL = 1.0
"""Density of holes [1/um^2] in the node at the surface from which they are a layer there.

Chosen: where holes pin the surface there are thousands; at twice the value the same nodes count."""


def hole_layer_error(potential: Potential) -> float:
    r"""Error of the potential at the surface where free holes pin it.

    Holes lie within :math:`kT / E` of the surface, 1 to 3 nm in the field E there; the node at the
    surface spreads them over half a cell h, and is too high by

    .. math:: \frac{kT}{q} \ln \frac{E h}{2 kT / q},

    which halving h lowers by 0.7 kT/q, 10 mV at 173 K.  Against a reference with cells of 0.25 nm it is
    right to 15 % (``tests/simulate/test_hole_layers.py``).  A change of the level of the holes acts
    right all the same.

    Parameters
    ----------
    potential : Potential
        Solution of a device.

    Returns
    -------
    error : float
        Largest error in the solved domain [V]; 0 where no holes lie at the surface.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> from bfsensor.simulate.unit_cell import solve_unit_cell
    >>> unit = solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8)
    >>> round(hole_layer_error(unit), 2)
    0.05
    """
    mesh, device = potential.mesh, potential.device
    kt = device.material.thermal_voltage(device.operating_point.temperature)
    eps = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    wide = dual_widths(mesh.x, mesh.side_x, mesh.period[0])[2]
    tall = dual_widths(mesh.y, mesh.side_y, mesh.period[1])[2]
    node = potential.holes.argmax(axis=0)
    y, x = np.indices(node.shape)
    step = mesh.z[node + 1] - mesh.z[node]
    sheet = potential.holes.max(axis=0) / np.outer(tall, wide)
    below = (potential.phi[node + 1, y, x] - potential.phi[node, y, x]) / step
    spread = np.maximum((sheet / eps + below) * step / (2 * kt), 1.0)
    return float(np.max(kt * np.log(spread) * (sheet > FULL)))
