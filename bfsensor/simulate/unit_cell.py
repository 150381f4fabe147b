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
        A mirror-symmetric device.
    charge : float
        Electrons in every pixel [e-].
    cells : int
        Cells a pixel.
    refine_z : int
        Halvings of the z mesh.

    Returns
    -------
    Potential
        On a quarter pixel.
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
        From :func:`solve_unit_cell`, same device and cells.
    mesh : Mesh
        Where the potential is wanted.

    Returns
    -------
    phi : ndarray, shape (nz, ny, nx)
        Potential [V].
    """

    def index(nodes: FloatArray, pitch: float, cell: FloatArray) -> NDArray[np.int64]:
        folded = np.abs(nodes - pitch * np.round(nodes / pitch))
        return np.argmin(np.abs(folded[:, None] - cell[None, :]), axis=1)

    ix = index(mesh.x, mesh.pitch[0], unit.mesh.x)
    iy = index(mesh.y, mesh.pitch[1], unit.mesh.y)
    return unit.phi[:, iy[:, None], ix[None, :]]
