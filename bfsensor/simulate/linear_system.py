r"""The linear system of a Newton step: Poisson's operator and the carriers' response to the potential.

Its matrix is :math:`A + (n + p) / kT`, less, in every pixel that keeps its number N of electrons, the
part :math:`n\, n^T / (N\, kT)` by which all of them move together.  Conjugate gradients solve it, with
one multigrid cycle as preconditioner.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels import carriers as carrier_kernels
from bfsensor._kernels import relaxation
from bfsensor.simulate.discretise import Coefficients
from bfsensor.simulate.mesh import Mesh
from bfsensor.simulate.multigrid import Multigrid
from bfsensor.typing import FloatArray

_MAX_CG = 200
"""Largest number of conjugate-gradient iterations of a Newton step; the next step goes on from there.

Chosen: a multigrid cycle about halves the error, so that the factor of 1e3 that is asked for takes
some ten; twice as many change only systems that hardly converge."""


class PixelNodes:
    """Pixels that the nodes of a mesh belong to.

    Parameters
    ----------
    mesh : Mesh
        Mesh of the array.

    Attributes
    ----------
    x, y : ndarray of int
        Pixel of every node along an axis, with halo; -1 on borders.
    share_x, share_y : ndarray
        Part of each pixel, along an axis, that lies inside the domain.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.x, self.share_x = _pixel_of_node(
            mesh.x, mesh.pitch[0], mesh.pixels("x"), mesh.side_x
        )
        self.y, self.share_y = _pixel_of_node(
            mesh.y, mesh.pitch[1], mesh.pixels("y"), mesh.side_y
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of pixels of the domain in y and in x."""
        return len(self.share_y), len(self.share_x)


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
    multigrid : Multigrid
        Preconditioner.
    electrons, holes : ndarray, shape (ny + 2, n_front, nx + 2)
        Carriers of each node [e-], about which the system is linearised, ``[y, z, x]`` with halo.
    residual, step : ndarray, shape (ny + 2, nz, nx + 2)
        Right-hand side [e-], which :meth:`solve` consumes, and solution [V].
    """

    def __init__(self, coefficients: Coefficients, pixels: PixelNodes, kt: float) -> None:
        self.coefficients, self.pixels, self._kt = coefficients, pixels, kt
        self.multigrid = Multigrid(coefficients)
        nz, ny, nx = coefficients.mesh.shape
        self.shape = (ny + 2, nz, nx + 2)
        front = (ny + 2, coefficients.n_front, nx + 2)
        self.electrons, self.holes = np.zeros(front), np.zeros(front)
        self.residual, self.step = np.zeros(self.shape), np.zeros(self.shape)
        self.stiffness = np.zeros(front)
        self._direction = np.zeros(self.shape)
        self._product = np.zeros(self.shape)
        self._preconditioned = np.zeros(self.shape)

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

    def linearise(self) -> None:
        """Linearise the carriers about their present numbers."""
        np.add(self.electrons, self.holes, out=self.stiffness)
        self.stiffness /= self._kt
        self.multigrid.set_carriers(self.stiffness)

    def without_carriers(self) -> None:
        """Take the carriers out, of the multigrid cycles, too."""
        self.electrons[...] = 0.0
        self.holes[...] = 0.0
        self.stiffness[...] = 0.0
        self.multigrid.set_carriers(self.stiffness)

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
        residual, direction, z = self.residual, self._direction, self._preconditioned
        self.multigrid.cycle(residual, z)
        rz = carrier_kernels.inner(residual, z)
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
            self.multigrid.cycle(residual, z)
            new = carrier_kernels.inner(residual, z)
            if new <= forcing**2 * first:
                return iteration
            carrier_kernels.next_direction(direction, z, new / rz)
            rz = new
        return _MAX_CG


def _pixel_of_node(
    nodes: FloatArray, pitch: float, pixels: NDArray[np.int64], side: str
) -> tuple[NDArray[np.int64], FloatArray]:
    """Pixel number of every node (with halo; -1 on borders) and each pixel's share inside."""
    offset = nodes / pitch + 0.5
    border = np.abs(offset - np.round(offset)) < 1e-6
    index = np.where(border, -1, np.floor(offset).astype(np.int64) - pixels[0])
    if side == "periodic":
        share = np.ones(len(pixels))
    else:
        low = np.maximum(nodes[0], (pixels - 0.5) * pitch)
        high = np.minimum(nodes[-1], (pixels + 0.5) * pitch)
        share = (high - low) / pitch
    return np.concatenate([[-1], index, [-1]]), share
