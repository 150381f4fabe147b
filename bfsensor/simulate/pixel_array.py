"""A periodic array of pixels, one of them holding another charge, solved from a nested start."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bfsensor.simulate.mesh import Mesh, make_mesh
from bfsensor.simulate.moved_mesh import move_mesh
from bfsensor.simulate.poisson import TOLERANCE, Electrostatics, Potential
from bfsensor.simulate.unit_cell import tile
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

NEAR = 3
"""Period of the small array that gives the charged pixel and its neighbours [pixel].

Chosen: beyond 1.5 pixels, half of it, the potential that the charge adds varies over several pixels, so
that half as many cells resolve it; a period of 6 has four times the nodes."""

_START_TOLERANCE = 1e-3
"""Iteration error of the solutions that only make a start [V].

Chosen: the start made of them is off by 1 to 60 mV, as the first Newton step then shows, through
their cells; at three times the value whole arrays take up to four cycles more, at a tenth as many."""

_FEWEST_CELLS = 16
"""Cells a pixel below which an array starts from repeated unit cells.

Chosen: half as many, 8, are the fewest of a mesh; at twice the value the coarsest whole array has four
times the nodes."""


class PixelArray:
    """A square array of a mirror-symmetric device, solved for one charged pixel on a background.

    A start close to the solution comes from a small array on the same cells, which holds the cloud
    of stored electrons, and from the whole array on half as many cells, less the small array on
    those: what the small array lacks, the far field, is smooth.  The whole array on half as many
    cells starts in the same way.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    period : int
        Pixels from a charge to its periodic image; half of them are solved, between mirror planes.
    cells : int
        Mesh cells per pixel in x and in y, even, at least 8.
    refine_z : int
        Number of times that every interval of the mesh in z is halved, 0 or more.
    laid_for : Device, optional
        Device near to this one whose mesh is made and then moved
        (:func:`~bfsensor.simulate.moved_mesh.move_mesh`); by default the device itself.

    Attributes
    ----------
    solver, unit_solver : Electrostatics
        Solver of the array, and of one pixel of a uniform array.
    mesh : Mesh
        Mesh of the array.

    Raises
    ------
    DeviceError
        The device has no mirror planes, or ``cells`` is odd or below 8.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> array = PixelArray(Device.load("itl_sta3800c"), period=4, cells=8)
    >>> potential = array.solve(50_000.0, 0.0)
    >>> potential.charges[0, 0], potential.charges[1:].max()
    (np.float64(50000.0), np.float64(0.0))
    """

    def __init__(
        self,
        device: Device,
        *,
        period: int,
        cells: int,
        refine_z: int = 0,
        laid_for: Device | None = None,
    ) -> None:
        model = device if laid_for is None else laid_for

        def solver(pixels: int, cells: int) -> Electrostatics:
            mesh = make_mesh(model, pixels=(pixels, pixels), cells=cells, refine_z=refine_z)
            return Electrostatics(device, move_mesh(mesh, model, device))

        self.solver, self.unit_solver = solver(period, cells), solver(1, cells)
        self.mesh = self.solver.mesh
        self._units: dict[float, Potential] = {}
        self._coarse: PixelArray | None = None
        self._near = solver(NEAR, cells) if period > NEAR else None
        self._added: tuple[tuple[float, float], FloatArray] | None = None
        if self._near is not None and cells % 4 == 0 and cells >= _FEWEST_CELLS:
            self._coarse = PixelArray(
                device,
                period=period,
                cells=cells // 2,
                refine_z=refine_z,
                laid_for=laid_for,
            )

    def unit(self, background: float) -> Potential:
        """Solve one pixel of a uniform array.

        Parameters
        ----------
        background : float
            Electrons in every pixel [e-], 0 or more.

        Returns
        -------
        solution : Potential
            Solution on a quarter of a pixel between mirror planes; the last one is kept.
        """
        if background not in self._units:
            empty = self.unit_solver.solve(0.0)
            full = (
                self.unit_solver.solve(background, start=empty.phi) if background else empty
            )
            self._units = {background: full}
        return self._units[background]

    def solve(
        self, charge: float, background: float, *, tolerance: float = TOLERANCE
    ) -> Potential:
        """Solve for a charge of pixel (0, 0), all others holding the background.

        Parameters
        ----------
        charge, background : float
            Electrons [e-], 0 or more.
        tolerance : float
            Iteration error that may be left [V].

        Returns
        -------
        solution : Potential
            Potential and carriers on a quarter of the period.

        Raises
        ------
        ConvergenceError
            Newton's method did not converge.
        DeviceError
            A charge is negative, or the silicon is not depleted.
        """
        start = tile(self.unit(background), self.mesh)
        if self._coarse is not None:
            coarse = self._coarse
            whole = coarse.solve(charge, background, tolerance=_START_TOLERANCE)
            far = whole.phi - tile(coarse.unit(background), coarse.mesh)
            _corner(far, coarse._near_added(charge, background), -1)
            start += _between(far, coarse.mesh, self.mesh)
            _corner(start, self._near_added(charge, background), 1)
        return _solve_on(self.solver, start, charge, background, tolerance)

    def _near_added(self, charge: float, background: float) -> FloatArray:
        """Potential that a charge adds in the small array [V]; the last one is kept."""
        key = charge, background
        if self._added is None or self._added[0] != key:
            assert self._near is not None  # only asked for where there is one
            tiled = tile(self.unit(background), self._near.mesh)
            near = _solve_on(self._near, tiled, charge, background, _START_TOLERANCE)
            self._added = key, near.phi - tiled
        return self._added[1]


def _corner(whole: FloatArray, part: FloatArray, sign: int) -> None:
    """Add a field of the small array to one of the whole array on the same cells, in place."""
    nz, ny, nx = part.shape
    whole[:nz, :ny, :nx] += sign * part


def _solve_on(
    solver: Electrostatics,
    start: FloatArray,
    charge: float,
    background: float,
    tolerance: float,
) -> Potential:
    charges = np.full(solver.pixel_shape, background)
    charges[0, 0] = charge
    return solver.solve(charges, start=start, tolerance=tolerance)


def _between(field: FloatArray, coarse: Mesh, fine: Mesh) -> FloatArray:
    """Interpolate a field linearly in x and y, to a mesh with a node between every two of its own."""
    for axis, have, want in ((1, coarse.y, fine.y), (2, coarse.x, fine.x)):
        count = len(want)
        out = np.empty((*field.shape[:axis], count, *field.shape[axis + 1 :]))
        old, new = np.moveaxis(field, axis, -1), np.moveaxis(out, axis, -1)
        part = (want[1::2] - have[:-1]) / np.diff(have)
        new[..., ::2] = old
        new[..., 1::2] = (1 - part) * old[..., :-1] + part * old[..., 1:]
        field = out
    return field
