r"""Transport of single electrons to the wells: drift and diffusion in a solved field.

There are two engines.  ``'steps'``, for production: with Einstein's relation an electron obeys, in
the time :math:`ds = \mu\,dt`,

.. math:: dX = E\,ds + \sqrt{2 kT}\,dW,

so that the mobility drops out of where it ends; steps are a fraction of the height above
the silicon surface.  ``'scattering'``, the reference (Lage, Bradshaw & Tyson 2017): free
flights of exponential duration :math:`\tau = m \mu(E) / q` at thermal speed in random
directions, with the drift velocity on top.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor._kernels import transport as kernels
from bfsensor.device import silicon
from bfsensor.device.device import Device
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.simulate.field import Field
from bfsensor.simulate.mesh import Surfaces
from bfsensor.simulate.poisson import Potential
from bfsensor.typing import FloatArray
from bfsensor.units import ELECTRON_MASS

PUBLISHED_DIFFUSION = 2.30 * float(np.sqrt(8.0 / (3.0 * np.pi)))
r"""Width of the diffusion in the published simulations relative to Einstein's relation.

Derived from the published multiplier 2.30 (Lage, Bradshaw & Tyson 2017), which counts in mean
thermal speeds :math:`\sqrt{8kT/\pi m}`, where Einstein's relation asks for the root mean square,
:math:`\sqrt{3kT/m}`.  Its square, the ratio of the diffusion coefficients, is 4.5."""

ARRIVED, ABSORBED = kernels.ARRIVED, kernels.ABSORBED
"""Fates of an electron: collected by a well, or lost at the back surface."""

_MOST_FLIGHTS = 40_000
"""Largest number of free flights of a scattering electron; beyond it a ConvergenceError is raised.

Chosen: twice as many only make a failure take twice as long, and kept paths twice the memory."""

_MOST_STEPS = 5000
"""Largest number of large steps of an electron; beyond it a ConvergenceError is raised.

Chosen: far above the some 100 steps of a straight way; twice as many only make a failure take twice
as long, and kept paths twice the memory."""


@dataclass(frozen=True)
class Transport:
    """Model of drift and diffusion, and the steps with which it is integrated.

    Parameters
    ----------
    diffusion : float, optional
        Width of the diffusion over that by Einstein's relation, 0 or more; 0 switches it off.  By
        default the device's, as in a sensor.
    engine : {'steps', 'scattering'}
        Large steps of drift and diffusion, or free flights from collision to collision.
    part : float
        Length of a large step relative to the height above the silicon surface, 0.001 to 1.
    shortest, longest : float
        Shortest and longest large step [um], 0.001 to 10 and 0.001 to 50.
    free_time : {'local', 'start'}
        Mean free time of scattering electrons: from the mobility at their position, or, as in the
        published simulations, from that where they started.
    back_absorption : float
        Probability, 0 to 1, that an electron which touches the back surface is lost there; else
        it is reflected.

    Raises
    ------
    DeviceError
        A value lies outside its limits.

    Notes
    -----
    Beside a full pixel the default steps give the same share of electrons to a well as steps
    a fourth as long within 0.2 % at Einstein's width; at the published width they give
    0.9 % less (errors 0.2 and 0.3 %, ``validation/transport/transport.ipynb``).

    Examples
    --------
    >>> Transport(diffusion=PUBLISHED_DIFFUSION).engine
    'steps'
    """

    diffusion: float | None = None
    engine: Literal["steps", "scattering"] = "steps"
    part: float = 0.25
    shortest: float = 0.1
    longest: float = 5.0
    free_time: Literal["local", "start"] = "local"
    back_absorption: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values outside their limits."""
        for name, low, high in (
            ("diffusion", 0.0, np.inf),
            ("part", 1e-3, 1.0),
            ("shortest", 1e-3, 10.0),
            ("longest", 1e-3, 50.0),
            ("back_absorption", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if value is None:
                continue
            if not low <= value <= high or not np.isfinite(value):
                raise DeviceError(
                    f"transport: {name} = {value} must be from {low:g} to {high:g}"
                )
        for name, choices in (
            ("engine", ("steps", "scattering")),
            ("free_time", ("local", "start")),
        ):
            if getattr(self, name) not in choices:
                raise DeviceError(
                    f"transport: {name} = {getattr(self, name)!r} must be one of {choices}"
                )

    def width_in(self, device: Device) -> float:
        """Width of the diffusion in a device over that by Einstein's relation."""
        return device.diffusion if self.diffusion is None else float(self.diffusion)


@dataclass(frozen=True)
class Electrons:
    """Traced electrons: last positions, pixels, fates and paths.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        Last positions (x, y, z) [um].
    pixels : ndarray of int, shape (n, 2)
        Pixels (i, j) along x and y; without meaning where ``fates`` is not ``ARRIVED``.
    fates : ndarray of int, shape (n,)
        ``ARRIVED`` (0), in a well, or ``ABSORBED`` (1), by the back surface.
    paths : tuple of ndarray, each shape (points, 3)
        Paths [um]; empty unless they were asked for.
    """

    positions: FloatArray
    pixels: NDArray[np.int64]
    fates: NDArray[np.int64]
    paths: tuple[FloatArray, ...] = ()


class Tracer:
    """Tracer of electrons in one solved potential.

    Parameters
    ----------
    potential : Potential
        Solution of :class:`~bfsensor.simulate.poisson.Electrostatics`.

    Attributes
    ----------
    potential : Potential
        The same solution.
    field : Field
        The potential, padded for interpolation.
    field_arrays : tuple of ndarray
        Arrays of ``field`` in the order of the kernels' arguments.

    Examples
    --------
    >>> from bfsensor import Device
    >>> from bfsensor.simulate.unit_cell import solve_unit_cell
    >>> empty = solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8)
    >>> starts = [[1.0, 2.0, 95.0], [4.0, -8.0, 95.0]]
    >>> Tracer(empty).trace(starts, seed=8231, transport=Transport(diffusion=0)).pixels
    array([[ 0,  0],
           [ 0, -1]])
    """

    def __init__(self, potential: Potential) -> None:
        self.potential = potential
        self.field = Field.of(potential)
        device, mesh = potential.device, potential.mesh
        surfaces = Surfaces.of(device)
        box = []
        for nodes, side, period in (
            (mesh.x, mesh.side_x, mesh.period[0]),
            (mesh.y, mesh.side_y, mesh.period[1]),
        ):
            box += [nodes[0], nodes[0] + period if side == "periodic" else nodes[-1]]
        self._room = kernels.Room(
            box=np.array(box),
            periodic_x=mesh.side_x == "periodic",
            periodic_y=mesh.side_y == "periodic",
            thickness=float(device.silicon.thickness),
            absorbed=0.0,
            surface=np.array([
                surfaces.silicon_channel, surfaces.silicon_stop, surfaces.stop_half_width,
                surfaces.taper, mesh.pitch[0],
            ]),
            zone=self.field.zone,
        )  # fmt: skip
        self._temperature = float(device.operating_point.temperature)
        self._kt = float(device.material.thermal_voltage(self._temperature))

    @property
    def field_arrays(self) -> tuple[FloatArray, ...]:
        """Padded potential and positions of its nodes, in the order of the kernels' arguments."""
        return self.field.phi, self.field.x, self.field.y, self.field.z

    def prepare(
        self, starts: ArrayLike, transport: Transport
    ) -> tuple[FloatArray, kernels.Room, float]:
        """Check positions and convert them to the arguments of the kernels.

        Parameters
        ----------
        starts : array_like, shape (n, 3)
            Positions (x, y, z) where electrons are set free [um], in the silicon.
        transport : Transport
            Model of the transport, of which the absorption at the back surface is used.

        Returns
        -------
        starts : ndarray, shape (n, 3)
            The same positions, contiguous.
        room : Room
            Limits of the domain and of the silicon.
        kt : float
            Thermal voltage [V].

        Raises
        ------
        DeviceError
            A start is not a number, or not in the silicon.
        """
        starts = np.ascontiguousarray(np.atleast_2d(starts), float)
        if starts.shape[1] != 3 or not np.isfinite(starts).all():
            raise DeviceError("starts must be finite numbers of shape (n, 3)")
        room = self._room._replace(absorbed=float(transport.back_absorption))
        low, high = float(room.surface[0]), room.thickness
        wrong = (starts[:, 2] < low) | (starts[:, 2] > high)
        if wrong.any():
            raise DeviceError(
                f"starts: z = {starts[wrong][0, 2]:g} um is not in the silicon, {low:g} to "
                f"{high:g} um"
            )
        return starts, room, self._kt

    def pixels_of(self, positions: FloatArray) -> NDArray[np.int64]:
        """Find the pixels that hold positions.

        Parameters
        ----------
        positions : ndarray, shape (n, 3)
            Positions (x, y, z) [um].

        Returns
        -------
        pixels : ndarray of int, shape (n, 2)
            Pixels (i, j) along x and y.
        """
        pitch = np.array(self.potential.mesh.pitch)
        return np.round(positions[:, :2] / pitch).astype(np.int64)

    def trace(
        self,
        starts: ArrayLike,
        *,
        seed: int,
        numbers: ArrayLike | None = None,
        transport: Transport | None = None,
        keep_paths: bool = False,
    ) -> Electrons:
        """Trace electrons to their wells.

        Parameters
        ----------
        starts : array_like, shape (n, 3)
            Positions (x, y, z) where electrons are set free [um], in the silicon; beyond the
            domain its field is continued periodically or mirrored.
        seed : int
            Seed of the random numbers, 0 to 2^64 - 1.
        numbers : array_like of int, shape (n,), optional
            The electrons' numbers in the exposure, which select their random numbers
            (default: 0, 1, ...).
        transport : Transport, optional
            Model of drift and diffusion.
        keep_paths : bool
            Whether to return the paths.

        Returns
        -------
        electrons : Electrons
            Last positions, pixels, fates and, if asked for, paths.

        Raises
        ------
        DeviceError
            A start is not a number, or not in the silicon.
        ConvergenceError
            An electron found no well.
        """
        transport = transport or Transport()
        width = transport.width_in(self.potential.device)
        starts, room, kt = self.prepare(starts, transport)
        count = len(starts)
        names = np.arange(count) if numbers is None else np.asarray(numbers)
        key0, key1 = np.uint32(seed & 0xFFFFFFFF), np.uint32(seed >> 32 & 0xFFFFFFFF)
        out = np.empty((count, 3))
        fates = np.empty(count, np.int64)
        most = _MOST_FLIGHTS if transport.engine == "scattering" else _MOST_STEPS
        paths = np.empty((count, most + 1, 3) if keep_paths else (0, 0, 3))
        length = np.zeros(count if keep_paths else 0, np.int64)
        field = self.field_arrays
        tail = (starts, names.astype(np.uint64), key0, key1, out, fates, paths, length)
        if transport.engine == "steps":
            pace = kernels.Pace(
                float(transport.part),
                float(transport.shortest),
                float(transport.longest),
                most,
            )
            kernels.walk(*field, room, pace, kt * width**2, *tail)
        else:
            mass = ELECTRON_MASS
            kernels.scatter(
                *field, room, most,
                width * float(np.sqrt(3.0 * kt / mass)), mass,
                silicon.mobility_law(self._temperature), transport.free_time == "start", *tail,
            )  # fmt: skip
        if (fates == kernels.LOST).any():
            first = int(np.argmax(fates == kernels.LOST))
            x, y, z = out[first]
            raise ConvergenceError(
                f"{np.count_nonzero(fates == kernels.LOST)} of {count} electrons found no well in "
                f"{most} steps; the first stands at ({x:.3g}, {y:.3g}, {z:.3g}) um",
                [],
            )
        return Electrons(
            out, self.pixels_of(out), fates,
            tuple(paths[n, : length[n]].copy() for n in range(count)) if keep_paths else (),
        )  # fmt: skip
