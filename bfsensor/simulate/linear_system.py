r"""The linear system of a Newton step: Poisson's operator and the carriers' response to the potential.

Its matrix is :math:`A + (n + p) / kT`, less, in every pixel that keeps its number N of electrons, the
part :math:`n\, n^T / (N\, kT)` by which all of them move together.  Conjugate gradients solve it, with
one multigrid cycle and shifts of whole pixels as preconditioner.
"""

from __future__ import annotations

import contextlib
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels import carriers as carrier_kernels
from bfsensor._kernels import relaxation
from bfsensor.simulate.discretise import Coefficients
from bfsensor.simulate.multigrid import Multigrid
from bfsensor.simulate.pixel_nodes import PixelNodes
from bfsensor.simulate.pixel_shifts import PixelShifts
from bfsensor.typing import FloatArray

_MAX_CG = 200
"""Largest number of conjugate-gradient iterations of a Newton step; the next step goes on from there.

Chosen: a multigrid cycle about halves the error, so that the factor of 1e3 that is asked for takes
some ten; twice as many change only systems that hardly converge."""


_ROUGH = 0.1
"""Relative error of a system, in the energy norm, from which it is solved without shifts of pixels.

Chosen: the first systems of Newton's method take one or two iterations to it, as many as the shifts
cost; at half the value the third system of ITL or E2V has no shifts either, and the next more to do."""

_UNAIDED = 4
"""Iterations after which such a system gets its shifts all the same.

Chosen: they cost two iterations; around a spot, whose charges change by 2 % from step to step, the
first system takes 14 without them and 7 with them, and 10 or 11 if they are made after twice as many."""


class LinearSystem:
    """Linear systems of one device on one mesh; the arrays of an iteration are kept.

    Parameters
    ----------
    coefficients : Coefficients
        Discretised device.
    pixels : PixelNodes
        Pixels of the nodes.
    kt : float
        Thermal voltage [V].

    Attributes
    ----------
    electrons, holes : ndarray, shape (ny + 2, n_front, nx + 2)
        Carriers of each node [e-], about which the system is linearised, ``[y, z, x]`` with halo.
    residual, step : ndarray, shape (ny + 2, nz, nx + 2)
        Right-hand side [e-], which :meth:`solve` consumes, and solution [V].
    """

    def __init__(self, coefficients: Coefficients, pixels: PixelNodes, kt: float) -> None:
        self.coefficients, self.pixels, self._kt = coefficients, pixels, kt
        nz, ny, nx = coefficients.mesh.shape
        self.shape = (ny + 2, nz, nx + 2)
        front = (ny + 2, coefficients.n_front, nx + 2)
        self.electrons, self.holes = np.zeros(front), np.zeros(front)
        self.residual, self.step = np.zeros(self.shape), np.zeros(self.shape)
        self.stiffness = np.zeros(front)
        self._shifts: PixelShifts | None = None
        self._direction = np.zeros(self.shape)
        self._product = np.zeros(self.shape)

    @cached_property
    def multigrid(self) -> Multigrid:
        """Preconditioner, made when a system is first linearised."""
        return Multigrid(self.coefficients)

    def fill_halo(self, a: FloatArray) -> None:
        """Fill the halo of an array by the symmetry of the domain, in place."""
        mesh = self.coefficients.mesh
        relaxation.fill_halo(a, mesh.side_x == "periodic", mesh.side_y == "periodic")

    def unbalance(self, phi: FloatArray, out: FloatArray) -> None:
        """Write the charge [e-] that a potential [V] leaves unbalanced, carriers included."""
        c = self.coefficients
        self.stiffness[...] = 0.0
        relaxation.residual(
            phi, c.source, self.stiffness, c.cx, c.cy, c.cz, c.cd, c.kind, c.north,
            c.south, c.dy, out,
        )  # fmt: skip
        out[:, : c.n_front] += self.holes - self.electrons

    def linearise(self, *, near: bool = False) -> None:
        """Linearise the carriers about their present numbers.

        Parameters
        ----------
        near : bool
            Whether the carriers are nearly those of the last system, so that its shifts of pixels
            serve again; the solution does not depend on them.
        """
        np.add(self.electrons, self.holes, out=self.stiffness)
        self.stiffness /= self._kt
        self.multigrid.set_carriers(self.stiffness)
        if not near:
            self._shifts = None

    def without_carriers(self) -> None:
        """Take the carriers out, of the multigrid cycles, too."""
        self.electrons[...] = 0.0
        self.holes[...] = 0.0
        self.stiffness[...] = 0.0
        self.multigrid.set_carriers(self.stiffness)
        self._shifts = None

    def subtract(self, known: FloatArray, conserved: FloatArray) -> None:
        """Subtract the matrix times a known change of the potential [V] from the right-hand side.

        Parameters
        ----------
        known : ndarray, shape (ny + 2, nz, nx + 2)
            Change, with halo.
        conserved : ndarray, shape (pixels,)
            Electrons of pixels that keep their number [e-], 0 in others.
        """
        self._apply(known, conserved, np.zeros(conserved.size))
        self.residual -= self._product

    def _apply(self, a: FloatArray, conserved: FloatArray, work: FloatArray) -> float:
        """Matrix times a vector, to the product's array; returns the product with the vector."""
        c, p = self.coefficients, self.pixels
        curvature = relaxation.apply_operator(
            a, self.stiffness, c.cx, c.cy, c.cz, c.cd, c.kind, c.north, c.south, c.dy,
            self._product,
        )  # fmt: skip
        if np.any(conserved > 0):
            curvature -= carrier_kernels.subtract_common_shift(
                self.electrons, p.y, p.x, len(p.share_x), conserved, self._kt, a, work,
                self._product,
            )  # fmt: skip
        return float(curvature)

    def _precondition(self) -> NDArray[np.float32]:
        """Solve for the residual approximately; the next call writes to the same array."""
        out = self.multigrid.cycle(self.residual)
        if self._shifts is not None:
            self._shifts.add(self.residual, out)
        return out

    def _make_shifts(self, conserved: FloatArray) -> bool:
        """Make the shifts of pixels, where there are none yet; whether they were made."""
        if self._shifts is None and np.any(conserved > 0):
            # Without them a system takes more iterations, and has the same solution.
            with contextlib.suppress(np.linalg.LinAlgError):
                self._shifts = PixelShifts(
                    self.coefficients, self.pixels, self.multigrid, self.electrons,
                    self.stiffness, self._kt, conserved,
                )  # fmt: skip
                return True
        return False

    def solve(self, conserved: FloatArray, forcing: float) -> int:
        """Solve for the step by conjugate gradients; the right-hand side is consumed.

        Parameters
        ----------
        conserved : ndarray, shape (pixels,)
            Electrons of pixels that keep their number [e-], 0 in others.
        forcing : float
            Relative error, in the energy norm, at which the iteration ends.

        Returns
        -------
        iterations : int
            Number of iterations.
        """
        self.step[...] = 0.0
        work = np.zeros(max(conserved.size, 1))
        if forcing < _ROUGH:
            self._make_shifts(conserved)
        residual, direction = self.residual, self._direction
        z = self._precondition()
        rz = float(carrier_kernels.inner(residual, z))
        if rz <= 0.0:
            return 0
        direction[...] = z
        first = rz
        for iteration in range(1, _MAX_CG + 1):
            self.fill_halo(direction)
            curvature = self._apply(direction, conserved, work)
            carrier_kernels.step_solution(
                self.step, direction, residual, self._product, rz / curvature
            )
            z = self._precondition()
            new = float(carrier_kernels.inner(residual, z))
            if new <= forcing**2 * first:
                return iteration
            if iteration == _UNAIDED and self._make_shifts(conserved):
                z = self._precondition()
                rz = float(carrier_kernels.inner(residual, z))
                direction[...] = z  # conjugate gradients begin again
                continue
            carrier_kernels.next_direction(direction, z, new / rz)
            rz = new
        return _MAX_CG
