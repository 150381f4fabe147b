r"""What a converged potential does when the device changes a little.

The residual of a solution, :math:`R(\phi, \theta) = Q_{fixed} + p - n - A\phi`, stays 0 when a
quantity :math:`\theta` of the device changes, so that

.. math::
    d\phi / d\theta = J^{-1}\, \partial R / \partial\theta, \qquad J = -\partial R/\partial\phi,

with the matrix of Newton's last step.  The device is put on the mesh again for the right-hand
side, at the same potential node by node: one linear system a quantity instead of two solutions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.simulate.mesh import Mesh
from bfsensor.simulate.moved_mesh import move_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.simulate.unit_cell import tile
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

TOLERANCE = 1e-3
"""Relative error of a change in the norm of the energy, beyond that of the uniform array.

At 3e-3 derivatives of shifts were wrong by up to 8 %, at 1e-3 and below by less than 1 %."""

_UNIT_TOLERANCE = 1e-7


@dataclass(frozen=True)
class PotentialChange:
    """Change of a solution for a unit of a quantity of the device.

    Attributes
    ----------
    at_nodes : ndarray, shape (nz, ny, nx)
        Of the potential at nodes that move with the device [V a unit].
    velocity : tuple of ndarray
        Of the nodes in x, y and z [um a unit].
    step : float
        Change of the quantity over which the difference was taken.
    iterations : int
        Of the conjugate gradients.
    unit : PotentialChange, optional
        Of the unit cell, where that was used.
    """

    at_nodes: FloatArray = field(repr=False)
    velocity: tuple[FloatArray, FloatArray, FloatArray] = field(repr=False)
    step: float
    iterations: int
    unit: PotentialChange | None = field(default=None, repr=False)

    @property
    def moves(self) -> bool:
        """Whether nodes move."""
        return any(np.any(v) for v in self.velocity)


class Tangent:
    """Derivatives of one solution by quantities of its device.

    Parameters
    ----------
    solver : Electrostatics
        Which solved it, on a mesh of ``make_mesh`` or a moved one.  It keeps the matrix until it
        solves something else.
    potential : Potential
        The solution.
    unit : Tangent, optional
        Of a unit cell of the same array: its change, which costs little, is repeated as what
        is known of the change.
    """

    def __init__(
        self, solver: Electrostatics, potential: Potential, unit: Tangent | None = None
    ) -> None:
        self.solver, self.potential, self.unit = solver, potential, unit
        self._own = solver.imbalance(potential.phi, potential.charges)

    def change(
        self, changed: Device, step: float, *, tolerance: float = TOLERANCE
    ) -> PotentialChange:
        """Differentiate by a quantity.

        Parameters
        ----------
        changed : Device
            The device with the quantity changed by a small ``step``, one that rounding allows
            and over which holes, which go as exp(V/kT), change little: 1e-4 of an uncertainty
            does.
        step : float
            That change, in the unit that the derivative is wanted for.
        tolerance : float
            Relative error in the norm of the energy, of what the unit cell leaves.

        Returns
        -------
        PotentialChange

        Raises
        ------
        DeviceError
            The device cannot be put on the moved mesh.
        """
        solver, potential = self.solver, self.potential
        mesh = move_mesh(solver.mesh, solver.device, changed)
        start, small = None, None
        if self.unit is not None:
            small = self.unit.change(
                changed, step, tolerance=min(_UNIT_TOLERANCE, tolerance)
            )
            start = _repeat(small.at_nodes, self.unit.potential, solver.mesh)
        there = Electrostatics(changed, mesh, n_front=solver.coefficients.n_front)
        # The residual that the solution has of itself is not of the change.
        force = there.imbalance(potential.phi, potential.charges)
        force -= self._own
        force /= step
        at_nodes, iterations = solver.respond(
            potential, force, start=start, tolerance=tolerance
        )
        vx, vy, vz = (
            (getattr(mesh, a) - getattr(solver.mesh, a)) / step for a in ("x", "y", "z")
        )
        return PotentialChange(at_nodes, (vx, vy, vz), step, iterations, small)


def _repeat(values: FloatArray, unit: Potential, mesh: Mesh) -> FloatArray:
    """Values on the nodes of a unit cell, over the whole array."""
    return tile(replace(unit, phi=values), mesh)
