r"""Non-linear electrostatics of a sensor: potential, free holes, stored electrons.

Solves, in electron per node,

.. math::
    A \phi = Q_{fixed} + p(\phi) - n(\phi)

with holes :math:`p = n_i V e^{(\phi_h - \phi)/kT}` at one quasi-Fermi level and, in every
pixel, electrons :math:`n = N e^{\phi/kT} / \sum e^{\phi/kT}` of the prescribed number N.
The equations are solved by Newton's method, each of its linear systems by conjugate gradients with
one multigrid cycle as preconditioner.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor._kernels import carriers as carrier_kernels
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.simulate.discretise import discretise
from bfsensor.simulate.linear_system import LinearSystem
from bfsensor.simulate.mesh import Mesh
from bfsensor.simulate.multigrid import Multigrid
from bfsensor.simulate.pixel_nodes import PixelNodes
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

TOLERANCE = 1e-6
"""Iteration error [V] at which a solution counts as converged.

Derived: with :data:`AREA_PER_VOLT` at most 1e-3 um^2 of an area, of changes of some 10 um^2."""

AREA_PER_VOLT = 800.0
"""Bound on the area error that an iteration error of 1 V can make [um^2/V].

Derived: a field error of 1 V over a pixel (10 um), along the whole way of the electrons (100 um) in
0.5 V/um, moves a boundary by 20 um; four of them of 10 um move an area by 800 um^2."""

_MAX_NEWTON = 60
"""Largest number of Newton steps; beyond it a ConvergenceError is raised.

Chosen: twice as many only make a failure take twice as long."""

_FORCING = (1e-3, 0.1)
"""Smallest and largest relative error, in the energy norm, of the linear system of a Newton step.

Chosen: a multigrid cycle halves the error, so that 0.1 takes some four cycles; at twice the largest
value more Newton steps are taken, and at twice the smallest the last of them leave twice the error."""

_SAFETY = 6.0
"""Largest change of a solution, in units of the error that the last step of Newton's method lets expect.

Measured: up to 5 on both LSST devices, empty and on 44,000 e-, as the linear systems end by their
energy and not by their largest error; twice as large, solutions take one cycle more."""

_DENSE = 10.0
"""Density of electrons or holes above which a Newton step is damped [1/um^3].

Chosen: it is far below the density of stored electrons and implants, and of the order of the
background doping; at twice the value carriers may grow further in a step before they are damped.
The solution does not depend on it."""

_WELL_PER_ELECTRON = 3.0e-5
"""Fall of the quasi-Fermi level of a well per stored electron, only to start the iteration [V].

Chosen: about what the wells of shipped devices do; at twice the value the iteration starts further
from the solution, which does not depend on it."""


@dataclass(frozen=True)
class NewtonStep:
    """One step of Newton's method in a convergence history.

    Attributes
    ----------
    asked, taken : float
        Largest change of the potential that the linear system asks for, and that was made after
        damping [V].
    linear_iterations : int
        Number of conjugate-gradient iterations.
    residual : float
        Norm of the unbalanced charge before the step [e-].
    """

    asked: float
    taken: float
    linear_iterations: int
    residual: float


@dataclass(frozen=True)
class Potential:
    """A converged solution.

    Parameters
    ----------
    device : Device
        Device that was solved.
    mesh : Mesh
        Mesh on which it was solved.
    charges : ndarray, shape (pixels in y, pixels in x)
        Electrons stored in each (whole) pixel of the domain [e-].
    phi : ndarray, shape (nz, ny, nx)
        Potential [V] at the nodes.
    electrons, holes : ndarray, shape (n_front, ny, nx)
        Number of carriers of each node's cell [e-]; deeper planes hold none.
    silicon : ndarray, shape (n_front, ny, nx)
        Silicon volume of each node's cell [um^3].
    quasi_fermi : ndarray, shape of ``charges``
        Electron quasi-Fermi level of each pixel [V]; nan where empty.
    error_volts : float
        Bound on the iteration error that is left [V].
    history : tuple of NewtonStep
        Steps of Newton's method, in order.
    """

    device: Device
    mesh: Mesh
    charges: FloatArray
    phi: FloatArray = field(repr=False)
    electrons: FloatArray = field(repr=False)
    holes: FloatArray = field(repr=False)
    silicon: FloatArray = field(repr=False)
    quasi_fermi: FloatArray = field(repr=False)
    error_volts: float
    history: tuple[NewtonStep, ...] = field(repr=False)

    @property
    def linear_iterations(self) -> int:
        """Conjugate-gradient iterations of all Newton steps."""
        return sum(step.linear_iterations for step in self.history)


class Electrostatics:
    """The electrostatics of one device on one mesh, for any number of charge patterns.

    Coefficients and multigrid hierarchy are built once and kept; results do not depend
    on what was solved before, apart from the start that is passed in.

    Parameters
    ----------
    device : Device
        Device without an edge.
    mesh : Mesh
        Mesh of the device, from :func:`~bfsensor.simulate.mesh.make_mesh`.
    n_front : int, optional
        Number of planes from the gates up that may hold free carriers; by default those up to the
        end of the deepest implant.

    Raises
    ------
    DeviceError
        The device has an edge.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> from bfsensor.simulate.mesh import make_mesh
    >>> device = Device.load("itl_sta3800c")
    >>> solver = Electrostatics(device, make_mesh(device, pixels=(1, 1), cells=8))
    >>> solution = solver.solve(20_000.0)
    >>> bool(solution.error_volts < TOLERANCE)
    True
    """

    def __init__(self, device: Device, mesh: Mesh, *, n_front: int | None = None) -> None:
        self.device = device
        self.mesh = mesh
        coefficients = discretise(device, mesh)
        if n_front is not None:
            coefficients = replace(coefficients, n_front=n_front)
        self.coefficients = coefficients
        temperature = device.operating_point.temperature
        self._kt = device.material.thermal_voltage(temperature)
        self._ni = device.material.intrinsic_density(temperature)
        self._fermi_h = device.operating_point.hole_quasi_fermi_level
        self.pixels = PixelNodes(mesh)
        self.system = LinearSystem(coefficients, self.pixels, self._kt)
        self._linearised: Potential | None = None  # whose carriers the linear system holds

    @property
    def multigrid(self) -> Multigrid:
        """Preconditioner of the linear systems, which counts its cycles."""
        return self.system.multigrid

    @property
    def pixel_shape(self) -> tuple[int, int]:
        """Number of pixels of the domain in y and in x."""
        return self.pixels.shape

    def solve(
        self,
        charges: ArrayLike,
        *,
        start: FloatArray | None = None,
        tolerance: float = TOLERANCE,
    ) -> Potential:
        """Solve for given electrons in each pixel.

        Parameters
        ----------
        charges : array_like, shape ``pixel_shape`` or scalar
            Electrons in each pixel [e-], 0 or more, counted for the whole pixel even where a
            mirror plane cuts it.
        start : ndarray, shape (nz, ny, nx), optional
            Potential to start from [V]; by default the linear solution without carriers, held
            above the level of the holes.
        tolerance : float
            Iteration error that may be left [V], above 0.

        Returns
        -------
        solution : Potential
            Potential and carriers, converged to ``tolerance``.

        Raises
        ------
        ConvergenceError
            Newton's method did not converge; the error holds its steps [V] as ``history``.
        DeviceError
            A number of electrons is negative, or free holes reach the end of their region because
            the silicon above is not depleted.
        """
        charges = np.array(np.broadcast_to(np.asarray(charges, float), self.pixel_shape))
        if not np.all(charges >= 0):
            raise DeviceError(f"stored charge {charges.min():g} e- must not be negative")
        count = self._counts(charges)
        self._linearised = None
        if start is None:
            start = self._empty_start()
        phi = self._padded(start)
        history: list[NewtonStep] = []
        new = self._open_wells(phi, charges.ravel())
        if new is not None:
            self._newton(phi, count, history, 1.0, fermi=new)
        error = self._newton(phi, count, history, tolerance)
        fermi = self._fermi_levels(phi, count)
        c = self.coefficients
        self._set_carriers(phi, fermi, count > 0)
        self._check_hole_region()

        def inner(a: FloatArray) -> FloatArray:
            return np.moveaxis(a[1:-1, :, 1:-1], 1, 0).copy()

        silicon = c.silicon[c.kind[1:-1]][:, : c.n_front] * c.dy[1:-1, None, None]
        return Potential(
            device=self.device,
            mesh=self.mesh,
            charges=charges,
            phi=inner(phi),
            electrons=inner(self.system.electrons),
            holes=inner(self.system.holes),
            silicon=np.moveaxis(silicon[:, :, 1:-1], 1, 0).copy(),
            quasi_fermi=np.where(count > 0, fermi, np.nan).reshape(self.pixel_shape),
            error_volts=error,
            history=tuple(history),
        )

    def imbalance(self, phi: FloatArray, charges: ArrayLike) -> FloatArray:
        """Compute the charge that a potential leaves unbalanced, node by node.

        Parameters
        ----------
        phi : ndarray, shape (nz, ny, nx)
            Potential [V], not necessarily a solution.
        charges : array_like, shape ``pixel_shape`` or scalar
            Electrons in each pixel [e-].

        Returns
        -------
        residual : ndarray, shape (ny + 2, nz, nx + 2)
            Unbalanced charge [e-], ``[y, z, x]`` with halo, as :meth:`respond` takes it.
        """
        self._linearised = None
        padded, count = self._padded(phi), self._counts(charges)
        self._set_carriers(padded, self._fermi_levels(padded, count), count > 0)
        out = np.zeros(self.system.shape)
        self.system.unbalance(padded, out)
        return out

    def respond(
        self,
        at: Potential,
        unbalanced: FloatArray,
        *,
        start: FloatArray | None = None,
        tolerance: float = 1e-3,
    ) -> tuple[FloatArray, int]:
        """Find the change of a solution that balances a small charge, to first order.

        It is the solution of the linear system of Newton's last step, J^-1 times the charge.

        Parameters
        ----------
        at : Potential
            Solution of this solver about which the equations are linearised.
        unbalanced : ndarray, shape (ny + 2, nz, nx + 2)
            Charge [e-], as :meth:`imbalance` returns it.
        start : ndarray, shape (nz, ny, nx), optional
            Approximate change [V]; only the rest is solved for.
        tolerance : float
            Error of that rest, relative to it, in the energy norm of the linear system.

        Returns
        -------
        change : ndarray, shape (nz, ny, nx)
            Change of the potential [V].
        iterations : int
            Number of conjugate-gradient iterations.
        """
        system, count = self.system, self._counts(at.charges)
        if self._linearised is not at:
            self.imbalance(at.phi, at.charges)
            system.linearise()
            self._linearised = at
        system.residual[...] = unbalanced
        if start is not None:
            system.subtract(self._padded(start), count)
        iterations = system.solve(count, tolerance)
        change = np.moveaxis(system.step[1:-1, :, 1:-1], 1, 0)
        return (change.copy() if start is None else change + start), iterations

    # -- the pieces ------------------------------------------------------------------

    def _counts(self, charges: ArrayLike) -> FloatArray:
        """Electrons of each pixel inside the domain."""
        whole = np.broadcast_to(np.asarray(charges, float), self.pixel_shape)
        shares = self.pixels.share_y[:, None], self.pixels.share_x[None, :]
        return np.asarray(whole * shares[0] * shares[1]).ravel()

    def _set_carriers(
        self, phi: FloatArray, levels: FloatArray, filled: NDArray[np.bool_]
    ) -> None:
        """Count the carriers of a potential at quasi-Fermi levels, for the linear system."""
        c, p = self.coefficients, self.pixels
        carrier_kernels.mobile_charge(
            phi, c.silicon[:, : c.n_front], c.kind, c.dy, p.y, p.x, len(p.share_x), levels,
            filled, self._fermi_h, self._ni, self._kt, self.system.electrons,
            self.system.holes,
        )  # fmt: skip

    def _padded(self, a: FloatArray) -> FloatArray:
        """Copy a field ``[z, y, x]`` into the layout of the kernels, ``[y, z, x]`` with halo."""
        out = np.zeros(self.system.shape)
        out[1:-1, :, 1:-1] = np.moveaxis(a, 0, 1)
        self.system.fill_halo(out)
        return out

    def _empty_start(self) -> FloatArray:
        """A first guess without carriers: linear solution, held above the hole level."""
        c, system = self.coefficients, self.system
        system.without_carriers()
        phi = np.zeros(system.shape)
        conductor = c.conductor[c.kind[1:-1]]
        phi[1:-1] = np.where(conductor, c.source[1:-1] / c.dy[1:-1, None, None], 0.0)
        system.unbalance(phi, system.residual)
        system.solve(np.zeros(1), 1e-3)
        phi += system.step
        floor = self._fermi_h - self._kt * np.log(1e3 / self._ni)
        front = phi[:, : c.n_front]
        silicon = c.silicon[c.kind][:, : c.n_front] > 0
        front[silicon] = np.maximum(front[silicon], floor)
        return np.moveaxis(phi[1:-1, :, 1:-1], 1, 0).copy()

    def _open_wells(self, phi: FloatArray, charges: FloatArray) -> FloatArray | None:
        """Lower the potential, in place, of wells that are to be filled but are empty in the start.

        The maximum of an empty well lies far above any electron level.  The potential is cut
        where a plausible number of electrons would hold it.  Returns the quasi-Fermi levels [V]
        to start from, or None if there is no such well.
        """
        c = self.coefficients
        n_px = len(self.pixels.share_x)
        top = np.zeros(charges.size)
        carrier_kernels.highest_potential(
            phi,
            c.silicon[:, : c.n_front],
            c.kind,
            self.pixels.y,
            self.pixels.x,
            n_px,
            top,
        )
        level = top - self._kt * np.log(1e4 / self._ni)
        # A cloud is a plateau: its maximum is within a few kT of the level.  An empty well
        # would hold many times its charge at the level that this density needs.
        count = (
            charges * (self.pixels.share_y[:, None] * self.pixels.share_x[None, :]).ravel()
        )
        held = np.zeros(charges.size)
        carrier_kernels.count_electrons(
            phi, c.silicon[:, : c.n_front], c.kind, c.dy, self.pixels.y, self.pixels.x, n_px,
            level, self._kt, held,
        )  # fmt: skip
        held *= self._ni
        new = (charges > 0) & (held < 0.2 * count)
        if not new.any():
            return None
        fermi = self._fermi_levels(phi, count)
        level = top - _WELL_PER_ELECTRON * charges
        fermi = np.where(new, level, fermi)
        ceiling = level + self._kt * np.log(3e3 / self._ni)
        py, px = self.pixels.y, self.pixels.x
        for p in np.nonzero(new)[0]:
            rows = np.nonzero(py == p // n_px)[0]
            columns = np.nonzero(px == p % n_px)[0]
            block = np.ix_(rows, np.arange(c.n_front), columns)
            here = (c.silicon[c.kind[rows]][:, : c.n_front][:, :, columns]) > 0
            values = phi[block]
            phi[block] = np.where(here, np.minimum(values, ceiling[p]), values)
        self.system.fill_halo(phi)
        return fermi

    def _fermi_levels(self, phi: FloatArray, count: FloatArray) -> FloatArray:
        """Quasi-Fermi level [V] at which each pixel holds its count."""
        c = self.coefficients
        n_px = len(self.pixels.share_x)
        reference = np.zeros(count.size)
        front = c.silicon[:, : c.n_front]
        carrier_kernels.highest_potential(
            phi, front, c.kind, self.pixels.y, self.pixels.x, n_px, reference
        )
        total = np.zeros(count.size)
        carrier_kernels.count_electrons(
            phi,
            front,
            c.kind,
            c.dy,
            self.pixels.y,
            self.pixels.x,
            n_px,
            reference,
            self._kt,
            total,
        )
        filled = count > 0
        out = np.full(count.size, 1e30)
        out[filled] = reference[filled] + self._kt * np.log(
            self._ni * total[filled] / count[filled]
        )
        return out

    def _newton(
        self,
        phi: FloatArray,
        count: FloatArray,
        history: list[NewtonStep],
        tolerance: float,
        fermi: FloatArray | None = None,
    ) -> float:
        """Newton's method in place; with ``fermi`` at fixed levels, else at fixed counts."""
        c, system = self.coefficients, self.system
        n_px = len(self.pixels.share_x)
        front = c.silicon[:, : c.n_front]
        fixed = fermi is not None
        conserved = np.zeros(count.size) if fixed else count
        filled = count > 0
        expected = np.inf
        asked = np.inf
        for _ in range(_MAX_NEWTON):
            levels = fermi if fermi is not None else self._fermi_levels(phi, count)
            self._set_carriers(phi, levels, filled)
            system.unbalance(phi, system.residual)
            norm = float(np.sqrt(np.sum(system.residual**2)))
            system.linearise(near=asked < self._kt)
            forcing = self._forcing(expected, tolerance)
            iterations = system.solve(conserved, forcing)
            shift = np.zeros(count.size) if fixed else self._common_shift(count)
            taken, asked = carrier_kernels.damped_update(
                phi, system.step, front, c.kind, self.pixels.y, self.pixels.x, n_px, levels, filled,
                self._fermi_h, shift, self._ni, self._kt, _DENSE,
            )  # fmt: skip
            system.fill_halo(phi)
            history.append(NewtonStep(asked, taken, iterations, norm))
            if not np.isfinite(asked):
                break
            # Two errors are left: that of the linear system, and Newton's quadratic term.  The
            # exponentials of the carriers change on the scale of kT, which sets the second.
            expected = asked * max(forcing, asked / self._kt)
            if _SAFETY * expected < tolerance:
                return _SAFETY * expected
        raise ConvergenceError(
            f"the potential did not converge to {tolerance:g} V in {len(history)} Newton steps "
            f"(last step {history[-1].asked:.3g} V)",
            [step.asked for step in history],
        )

    def _forcing(self, expected: float, tolerance: float) -> float:
        """Relative error at which a linear system ends, for a Newton step of an expected size [V].

        Newton's method neglects the square of its step: a part, step / kT, of the step is wrong
        however well its linear system is solved.  The system is therefore solved to that part, or to
        half of the tolerance where that is larger (Eisenstat & Walker 1996, SIAM J. Sci. Comput. 17,
        16).
        """
        worth_while = max(expected / self._kt, 0.5 * tolerance / (_SAFETY * expected))
        return float(np.clip(worth_while, _FORCING[0], _FORCING[1]))

    def _common_shift(self, count: FloatArray) -> FloatArray:
        """Mean step of each pixel's electrons [V], with which its quasi-Fermi level moves."""
        weighted = np.zeros(self.pixel_shape)
        system = self.system
        moved = np.einsum(
            "jki,jki->ji", system.electrons, system.step[:, : self.coefficients.n_front]
        )
        rows, columns = self.pixels.y >= 0, self.pixels.x >= 0
        np.add.at(
            weighted,
            (self.pixels.y[rows][:, None], self.pixels.x[columns][None, :]),
            moved[np.ix_(rows, columns)],
        )
        out = np.zeros(count.size)
        return np.divide(weighted.ravel(), count, out=out, where=count > 0)

    def _check_hole_region(self) -> None:
        """Refuse holes that reach the plane where they are no longer counted."""
        c = self.coefficients
        edge = self.system.holes[:, -1].max(initial=0.0)
        if edge > 1e-3 * max(self.system.holes.max(), 1e-3):
            raise DeviceError(
                f"free holes reach z = {self.mesh.z[c.n_front - 1]:.2f} um: the silicon between "
                "channel stops and back contact is not depleted (raise the back bias or lower "
                "the background doping)"
            )
