"""One pixel of a uniform array: its potential, and the same over a mesh of many pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.simulate.mesh import Mesh, make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device


def solve_unit_cell(
    device: Device, charge: float, *, cells: int = 16, refine_z: int = 0
) -> Potential:
    """Solve one pixel of a uniform array, every pixel with the same charge.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    charge : float
        Electrons in every pixel [e-], 0 or more.
    cells : int
        Mesh cells per pixel in x and in y, even, at least 8.
    refine_z : int
        Number of times that every interval of the mesh in z is halved, 0 or more.

    Returns
    -------
    solution : Potential
        Solution on a quarter of a pixel between mirror planes.

    Raises
    ------
    DeviceError
        The device has no mirror planes, or is not depleted.
    ConvergenceError
        Newton's method did not converge.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> empty = solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8)
    >>> empty.phi.shape[1:], bool(empty.electrons.any())
    ((5, 5), False)
    """
    mesh = make_mesh(device, pixels=(1, 1), cells=cells, refine_z=refine_z, symmetric=True)
    solver = Electrostatics(device, mesh)
    empty = solver.solve(0.0)
    return solver.solve(charge, start=empty.phi) if charge > 0 else empty


def tile(unit: Potential, mesh: Mesh) -> FloatArray:
    """Repeat the potential of a unit cell over a mesh with the same pixel nodes.

    Parameters
    ----------
    unit : Potential
        Solution of :func:`solve_unit_cell` for the same device and cells per pixel.
    mesh : Mesh
        Mesh of many pixels on which the potential is wanted.

    Returns
    -------
    phi : ndarray, shape (nz, ny, nx)
        Potential at the nodes of ``mesh`` [V].

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> device = Device.load("itl_sta3800c")
    >>> empty = solve_unit_cell(device, 0.0, cells=8)
    >>> tile(empty, make_mesh(device, pixels=(4, 4), cells=8)).shape[1:]
    (17, 17)
    """

    def index(nodes: FloatArray, pitch: float, cell: FloatArray) -> NDArray[np.int64]:
        folded = np.abs(nodes - pitch * np.round(nodes / pitch))
        return np.argmin(np.abs(folded[:, None] - cell[None, :]), axis=1)

    ix = index(mesh.x, mesh.pitch[0], unit.mesh.x)
    iy = index(mesh.y, mesh.pitch[1], unit.mesh.y)
    return unit.phi[:, iy[:, None], ix[None, :]]
