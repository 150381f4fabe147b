r"""Derivatives of a converged potential with respect to quantities of the device.

The residual of a solution, :math:`R(\phi, \theta) = Q_{fixed} + p - n - A\phi`, stays 0 when a
quantity :math:`\theta` of the device changes, so that

.. math::
    d\phi / d\theta = J^{-1}\, \partial R / \partial\theta, \qquad J = -\partial R/\partial\phi,

with the matrix of Newton's last step.  For the right-hand side the changed device is discretised
again, at the same potential node by node: one linear system per quantity instead of two solutions.
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
"""Relative error, in the energy norm, of the part of a change that the unit cell does not hold.

Chosen: at 3e-3 derivatives of edge shifts were wrong by up to 8 %, at 1e-3 and below by less than
1 %; the errors that are left are in ``validation/results/device_derivatives.ecsv``.  At 2e-3 the
error would lie between these."""

_UNIT_TOLERANCE = 1e-7
"""Relative error of the change of the unit cell, in the energy norm.

Chosen: the change is repeated over all pixels and is by far the largest part, so that its error must
be far below :data:`TOLERANCE` times the rest; twice as large saves less than an iteration."""


@dataclass(frozen=True)
class PotentialChange:
    """Derivative of a solution with respect to a quantity of the device.

    A unit below is that of the quantity.

    Attributes
    ----------
    at_nodes : ndarray, shape (nz, ny, nx)
        Derivative of the potential at nodes that move with the device [V per unit].
    velocity : tuple of ndarray
        Derivatives of the positions of the nodes in x, y and z [um per unit].
    step : float
        Change of the quantity over which the right-hand side was differenced [unit].
    iterations : int
        Number of conjugate-gradient iterations.
    unit : PotentialChange, optional
        Derivative of the unit cell's solution, where one was used.
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
    """Derivatives of one solution with respect to quantities of its device.

    Parameters
    ----------
    solver : Electrostatics
        Solver of the solution, on a mesh of ``make_mesh`` or a moved one.  It keeps the matrix
        until it solves something else.
    potential : Potential
        Solution to differentiate.
    unit : Tangent, optional
        Tangent of a unit cell of the same array.  Its derivative, which costs little, is repeated
        over the array as a first approximation, and only the rest is solved for.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> from bfsensor.simulate.mesh import make_mesh
    >>> device = Device.load("itl_sta3800c")
    >>> solver = Electrostatics(device, make_mesh(device, pixels=(1, 1), cells=8))
    >>> tangent = Tangent(solver, solver.solve(0.0))
    >>> change = tangent.change(device.with_value("back_bias", "-49.99 V"), 0.01)
    >>> bool(abs(change.at_nodes[-1].mean() - 1) < TOLERANCE)  # the back contact itself
    True
    """

    def __init__(
        self, solver: Electrostatics, potential: Potential, unit: Tangent | None = None
    ) -> None:
        self.solver, self.potential, self.unit = solver, potential, unit
        self._own = solver.imbalance(potential.phi, potential.charges)

    def change(
        self, changed: Device, step: float, *, tolerance: float = TOLERANCE
    ) -> PotentialChange:
        """Differentiate the solution with respect to one quantity of the device.

        Parameters
        ----------
        changed : Device
            Device with the quantity changed by ``step``.  The change must be far above round-off
            and so small that holes, which go as exp(V/kT), change little: 1e-4 of the quantity's
            uncertainty serves.
        step : float
            Change of the quantity, in the unit in which the derivative is wanted; not 0.
        tolerance : float
            Relative error, in the energy norm, of the part that the unit cell does not hold.

        Returns
        -------
        change : PotentialChange
            Derivative per unit of the quantity.

        Raises
        ------
        DeviceError
            The mesh cannot be moved to the changed device.
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
        # The solution is not exact: its own residual is subtracted, which 1 / step would magnify.
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
    """Repeat values on the nodes of a unit cell over the nodes of the whole array."""
    return tile(replace(unit, phi=values), mesh)
