"""The differential response of a device: shifts of pixel edges per electron, and derivatives.

A small charge on a uniform background is solved for, and the shifts of the edges around it are
taken from the solution without a table.  Their derivatives with respect to any quantity of the
device come from the linearised system instead of solutions of other devices.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bfsensor._kernels.drift import ANY_TURN
from bfsensor.device.device import Device
from bfsensor.errors import TableError
from bfsensor.response.light import conversion_depths, mixed
from bfsensor.response.periodic_images import PERIOD, SAMPLES, Images
from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.boundaries import (
    BISECTION,
    TURN,
    Feet,
    PixelBoundaries,
    find_boundaries,
)
from bfsensor.simulate.boundary_tangent import boundary_changes
from bfsensor.simulate.far_field import FarField
from bfsensor.simulate.mesh import Surfaces
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.simulate.poisson import Potential
from bfsensor.simulate.tangent import TOLERANCE, PotentialChange, Tangent
from bfsensor.typing import Edges, FloatArray

LEVEL = 40_000.0
"""Charge in every pixel about which the response is taken [e-].

Chosen: the mean charge while a flat of 80,000 e- is filled, to first order.  The response falls with
the level: the ITL centre loses 12.8 um^2 per 100,000 e- at 10,000 e- and 11.4 at 130,000
(``docs/reference/accuracy.md``), so that twice the level gives a somewhat weaker effect."""

CHARGE = 5_000.0
"""Charge of the central pixel above the background [e-].

Chosen: the response is differential, and a charge must be small for that; twice as large, the
second-order part of the shifts doubles and the error of the traced boundaries per electron halves."""

REACH = 4
"""Largest offset of a pixel whose edges are solved [pixel]; a ring beyond it holds edges that do not
move.

Chosen: shifts fall as exp(-pi rho / T) with distance; twice the reach needs a longer :data:`PERIOD`
and more than doubles the time of the boundaries."""

VERTICES = 32
"""Number of vertices on an edge between corners, over which its mean shift is taken.

Chosen: vertices keep the areas of pixels exactly, so that the number enters only by the trapezoids
along an edge; twice as many have a quarter of that error."""

ITERATION = 2e-8
"""Iteration error of the solution [V].

Derived: with :data:`~bfsensor.simulate.poisson.AREA_PER_VOLT` at most 2e-5 um^2 of an area, 1 % of
what the lag (2, 2) gains from :data:`CHARGE`; at twice the value twice that."""

PRECISION = 1e-7
"""Width of the interval at which the bisection of boundary points ends [um].

Chosen: at the 1e-5 um of tables, small derivatives such as that with respect to the field oxide are
wrong by up to 25 %; twice as large saves one forward trace per point."""

REFINE_Z = 1
"""Number of times that the mesh in z is halved, from steps of 0.05 um in the front.

Measured (ITL, field oxide changed by up to 0.1 um either way): the sheet of stored electrons is not
thicker than two such steps, so that without halving a_00 wavers by 0.4 % as a parameter moves it
through them, which spoils second derivatives and small first ones; halved once a_00 is linear to
within 0.01 %.  ``docs/reference/accuracy.md`` states the errors of derivatives with and without it."""

_COARSE = 4
"""Number of vertices on an edge with which the change of the periodic images is found.

Chosen: the field of images half a period away is smooth over a pixel; twice as many change the
derivative by less than the field changes within a quarter of an edge."""

_SHIFT = 3e-3
"""Largest displacement to which derivatives of boundary lines are scaled before edges are refitted [um].

Chosen: the fit of edges to lines is nearly linear; twice as large doubles the error of this one-sided
difference and halves that of the corners' tolerance, 1e-7 um."""


@dataclass(frozen=True, eq=False)
class EdgeResponse:
    """Shifts of pixel edges per electron by conversion depth, and their derivatives.

    Parameters
    ----------
    depths : ndarray, shape (nd,)
        Conversion depths as heights above the gates [um]: at the first nothing moves, the last is
        the back surface.
    kx, ky : ndarray, shape (nd, 2 REACH + 3, 2 REACH + 3)
        Mean shifts of right and upper edges per electron [pixel/e-], [depth, row, column].
    dkx, dky : ndarray, shape (changes, nd, 2 REACH + 3, 2 REACH + 3)
        Derivatives of ``kx`` and ``ky`` with respect to each changed quantity [pixel/e- per unit],
        at depths that move with the thickness
        (:func:`~bfsensor.response.light.conversion_depths`).
    seconds : tuple of float
        CPU time [s] of the solution with its boundaries, and of all derivatives.
    error_volts : float
        Bound on the iteration error of the potential [V].
    """

    depths: FloatArray
    kx: FloatArray
    ky: FloatArray
    dkx: FloatArray
    dky: FloatArray
    seconds: tuple[float, float]
    error_volts: float

    def edges(self, wavelength: float | None, temperature: float) -> Edges:
        """Average the shifts over the conversion depths of light.

        Parameters
        ----------
        wavelength : float or None
            Wavelength [nm]; None: all light converts at the back surface.
        temperature : float
            Temperature of the silicon [K].

        Returns
        -------
        kx, ky : ndarray, shape (2 REACH + 3, 2 REACH + 3)
            Mean shifts of right and upper edges [pixel/e-], [row, column].
        """
        return mixed(self.kx, self.ky, self.depths, wavelength, temperature)


def area_matrix(kx: FloatArray, ky: FloatArray) -> FloatArray:
    """Compute the relative change of pixel areas per electron from the shifts of their edges.

    Parameters
    ----------
    kx, ky : ndarray, shape (..., ny, nx)
        Shifts of the right and of the upper edge of each pixel per electron [pixel/e-],
        [row, column].

    Returns
    -------
    areas : ndarray, shape (..., ny, nx)
        Relative change of each pixel's area [1/e-].  The first column and row take the last
        ones as their neighbours.

    Examples
    --------
    >>> kx = np.zeros((3, 3))
    >>> kx[1, 1] = -1e-6  # the right edge of the middle pixel moves inwards
    >>> areas = area_matrix(kx, np.zeros((3, 3)))
    >>> float(areas[1, 1]), float(areas[1, 2])
    (-1e-06, 1e-06)
    """
    return kx - np.roll(kx, 1, -1) + ky - np.roll(ky, 1, -2)


def solve_response(
    device: Device,
    *,
    level: float = LEVEL,
    charge: float = CHARGE,
    cells: int = 16,
    refine_z: int = REFINE_Z,
    period: int = PERIOD,
    laid_for: Device | None = None,
    changed: Sequence[tuple[Device, float]] = (),
    tolerance: float = TOLERANCE,
    precision: float = PRECISION,
) -> EdgeResponse:
    """Solve for the response of a device about a uniform background, and differentiate it.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    level : float
        Electrons in every pixel [e-], 0 or more.
    charge : float
        Electrons of the central pixel above the level [e-], not 0; shifts are divided by it.
    cells : int
        Mesh cells per pixel in x and in y, even, at least 8.
    refine_z : int
        Number of times that the mesh in z is halved (:data:`REFINE_Z`), 0 or more.
    period : int
        Pixels from a charge to its periodic image, even, above 2 REACH + 2; half of them are
        solved, between mirror planes.
    laid_for : Device, optional
        Device near to this one whose mesh is made and then moved
        (:func:`~bfsensor.simulate.moved_mesh.move_mesh`), so that the two compare without the
        error of the mesh; by default the device itself.
    changed : sequence of (Device, float)
        Quantities to differentiate by: for each the device with that quantity changed by a small
        step, and the step (:meth:`~bfsensor.simulate.tangent.Tangent.change`).
    tolerance : float
        Relative error of the linear systems of the derivatives, in the energy norm.
    precision : float
        Width of the interval at which the bisection of boundary points ends [um]: by default for
        derivatives and differences of devices; :data:`~bfsensor.simulate.boundaries.BISECTION`, as in
        tables, takes half of the time and is right to 0.1 % at lag 1, 0.4 % at (2, 2).

    Returns
    -------
    response : EdgeResponse
        Shifts by depth, and one derivative for each of ``changed``.

    Raises
    ------
    DeviceError
        The device has no mirror planes, or is not depleted.
    ConvergenceError
        A potential did not converge, or a boundary was not found.
    TableError
        The period is odd, or so short that images lie among the edges.

    Examples
    --------
    >>> from bfsensor import Device
    >>> solve_response(Device.load("itl_sta3800c"), period=10)
    Traceback (most recent call last):
        ...
    bfsensor.errors.TableError: period = 10 pixels must be even and above 10
    """
    if period % 2 or period <= 2 * REACH + 2:
        raise TableError(f"period = {period} pixels must be even and above {2 * REACH + 2}")
    began = time.process_time()
    array = PixelArray(
        device, period=period, cells=cells, refine_z=refine_z, laid_for=laid_for
    )
    unit = array.unit(level)
    potential = array.solve(level + charge, level, tolerance=ITERATION)
    stored, *higher = conversion_depths(device)
    depths = np.array(higher)
    feet: list[Feet] = []
    lines = find_boundaries(
        potential,
        depths,
        reach=REACH,
        samples=SAMPLES,
        precision=precision,
        turn=TURN if precision < BISECTION else ANY_TURN,
        feet=feet,
    )
    edges = _Edges.of(unit, depths, period, charge)
    moved = edges.moved(lines)
    kx, ky = edges.mean(moved)
    middle = time.process_time()
    tangent = Tangent(array.solver, potential, Tangent(array.unit_solver, unit))
    changes = [tangent.change(*c, tolerance=tolerance) for c in changed]
    dkx, dky = np.zeros((2, len(changes), *kx.shape))
    if changes:
        deeper = np.array([
            (np.array(conversion_depths(d)[1:]) - depths) / step for d, step in changed
        ])  # fmt: skip
        columns, rows = boundary_changes(potential, lines, feet, changes, deeper)
        for n, change in enumerate(changes):
            by_lines = edges.line_change(lines, columns[n], rows[n], (kx, ky))
            by_images = edges.image_change(unit, change, *changed[n], moved)
            dkx[n], dky[n] = by_lines[0] + by_images[0], by_lines[1] + by_images[1]

    def from_storage(shifts: FloatArray) -> FloatArray:
        """With those at the height of the stored charge, 0, before the others."""
        return np.concatenate([np.zeros_like(shifts[..., :1, :, :]), shifts], axis=-3)

    return EdgeResponse(
        np.array([stored, *higher]), from_storage(kx), from_storage(ky), from_storage(dkx),
        from_storage(dky), (middle - began, time.process_time() - middle), potential.error_volts,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Edges:
    """Conversion of boundary lines to mean shifts of edges [pixel/e-], periodic images removed."""

    far: FarField
    images: Images
    coarse: Images
    pitch: tuple[float, float]
    period: int
    charge: float

    @classmethod
    def of(cls, unit: Potential, depths: FloatArray, period: int, charge: float) -> _Edges:
        """Prepare for a device and its depths."""
        far = _far_field(unit, depths, period)
        images, coarse = (_images(far, unit, period, n) for n in (VERTICES, _COARSE))
        return cls(far, images, coarse, unit.mesh.pitch, period, charge)

    @staticmethod
    def moved(lines: PixelBoundaries) -> tuple[FloatArray, ...]:
        """Displacements of corners and vertices."""
        return lines.vertices(VERTICES, vertex_fractions(VERTICES))

    def mean(self, moved: tuple[FloatArray, ...]) -> Edges:
        """Mean shifts of edges, periodic images removed."""
        return self._mean(self.images.taken_off(moved)[0])

    def line_change(
        self, lines: PixelBoundaries, columns: FloatArray, rows: FloatArray, here: Edges
    ) -> Edges:
        """Change of the shifts ``here`` because the boundary lines move at these rates."""
        size = _SHIFT / max(np.abs(columns).max(), np.abs(rows).max(), 1e-30)
        further = replace(
            lines,
            columns=lines.columns + size * columns,
            rows=lines.rows + size * rows,
        )
        x, y = self.mean(self.moved(further))
        return (x - here[0]) / size, (y - here[1]) / size

    def image_change(
        self,
        unit: Potential,
        change: PotentialChange,
        device: Device,
        step: float,
        moved: tuple[FloatArray, ...],
    ) -> Edges:
        """Change of the shifts because the images' far field changes with the unit cell."""
        assert change.unit is not None  # made with one
        vx, vy, vz = change.unit.velocity
        mesh = unit.mesh
        there = replace(
            unit, device=device, phi=unit.phi + step * change.unit.at_nodes,
            mesh=replace(mesh, x=mesh.x + step * vx, y=mesh.y + step * vy, z=mesh.z + step * vz),
        )  # fmt: skip
        far = _far_field(there, np.array(conversion_depths(device)[1:]), self.period)
        other = _images(far, unit, self.period, _COARSE)
        at = np.linspace(0, VERTICES - 1, _COARSE).round().astype(int)
        few = moved[0], moved[1][..., at, :], moved[2][..., at, :]
        here, gone = (self._mean(i.taken_off(few)[0]) for i in (self.coarse, other))
        return (gone[0] - here[0]) / step, (gone[1] - here[1]) / step

    def _mean(self, moved: tuple[FloatArray, ...]) -> Edges:
        """Mean along each edge: trapezoids between corners and vertices."""
        corners, horizontal, vertical = moved
        nd, n = len(corners), 2 * REACH + 3
        kx, ky = np.zeros((2, nd, n, n))
        for out, ends, sides, axis in (
            (kx[:, 1:-1, :-1], corners[..., 0], vertical[..., 0], 1),
            (ky[:, :-1, 1:-1], corners[..., 1], horizontal[..., 1], 2),
        ):
            at = np.concatenate([[0.0], vertex_fractions(sides.shape[-1]), [1.0]])
            low, high = (
                np.take(ends, np.arange(k, ends.shape[axis] - 1 + k), axis) for k in (0, 1)
            )
            along = np.concatenate([low[..., None], sides, high[..., None]], -1)
            out[...] = np.trapezoid(along, at, axis=-1) / (
                self.charge * self.pitch[axis - 1]
            )
        return kx, ky


def _far_field(unit: Potential, depths: FloatArray, period: int) -> FarField:
    pitch = unit.mesh.pitch
    ground = Surfaces.of(unit.device).silicon_stop
    return FarField.of(unit, depths, ground, 5 * period * max(pitch))


def _images(far: FarField, unit: Potential, period: int, vertices: int) -> Images:
    pitch = unit.mesh.pitch
    apart = period * pitch[0], period * pitch[1]
    return Images.of(far, REACH, pitch, apart, vertex_fractions(vertices))
