r"""Clouds of electrons set free by X-rays, which repel one another while they drift.

A 5.9 keV photon of Fe55 makes 1620 electrons within some tenths of a micrometre.  Their
repulsion adds to the diffusion in the first micrometres; the holes leave for the back
surface within picoseconds and are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor._kernels import cloud as kernels
from bfsensor._kernels import transport as transport_kernels
from bfsensor.device import silicon
from bfsensor.direct.transport import Electrons, Tracer, Transport
from bfsensor.errors import ConvergenceError, SimulationError
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

FE55_ELECTRONS = 1620
"""Electrons of a Mn K-alpha photon: 5.898 keV / 3.64 eV a pair (Janesick 2001, chapter 2)."""

FE55_LENGTH = 28.8
"""Attenuation length of 5.9 keV photons in silicon [um].

Chosen: an estimate, good to some 5 %, from a mass attenuation coefficient near 150 cm^2/g (the
published simulations take 30 um); at twice the length clouds convert twice as deep on average."""

_MOST_STEPS = 20_000
"""Largest number of common steps of a cloud; beyond it a ConvergenceError is raised.

Chosen: a step is one of the slowest electron of the cloud; twice as many only make a failure take
twice as long."""


def fe55_cloud(
    *, seed: int, place: tuple[float, float], thickness: float, radius: float = 0.2,
    electrons: int = FE55_ELECTRONS, height: float | None = None,
) -> FloatArray:  # fmt: skip
    """Draw the electrons of one X-ray photon that comes through the back surface.

    Parameters
    ----------
    seed : int
        Seed of the random numbers, 0 or more.
    place : tuple of float
        Position (x, y) of the photon [um].
    thickness : float
        Thickness of the silicon [um], above 4.
    radius : float
        Rms radius of the cloud along an axis [um], above 0; 0.2 as in the published simulations.
    electrons : int
        Number of electrons, 1 or more.
    height : float, optional
        Height of the cloud's middle above the gates [um]; by default drawn from the attenuation
        length, from 4 um on.

    Returns
    -------
    starts : ndarray, shape (electrons, 3)
        Positions (x, y, z) where electrons are set free [um], within the silicon from 2 um above
        the gates.

    Raises
    ------
    SimulationError
        The radius is not above 0, or there are no electrons.

    Examples
    --------
    >>> starts = fe55_cloud(seed=8231, place=(0.0, 0.0), thickness=100.0, height=80.0)
    >>> starts.shape, bool(abs(starts[:, 2].mean() - 80.0) < 0.05)
    ((1620, 3), True)
    """
    if not (radius > 0 and electrons >= 1):
        raise SimulationError(
            f"cloud: radius = {radius} um must be above 0 um and electrons = {electrons} at least 1"
        )
    rng = np.random.default_rng([seed, 55])
    if height is None:
        lowest = np.exp(-(thickness - 4.0) / FE55_LENGTH)
        height = thickness + FE55_LENGTH * float(
            np.log(lowest + rng.random() * (1 - lowest))
        )
    starts = rng.normal((*place, height), radius, (electrons, 3))
    # The tail beyond the back surface is reflected; near the gates it is held at 2 um.
    starts[:, 2] = thickness - np.abs(thickness - starts[:, 2])
    return np.maximum(starts, (-np.inf, -np.inf, 2.0))


def trace_cloud(
    tracer: Tracer,
    starts: ArrayLike,
    *,
    seed: int,
    transport: Transport | None = None,
    repulsion: float = 1.0,
    softening: float | None = None,
) -> Electrons:
    """Trace electrons that drift at the same time and repel one another.

    Parameters
    ----------
    tracer : Tracer
        Tracer of the solved field.
    starts : array_like, shape (n, 3)
        Positions (x, y, z) where electrons are set free at the same time [um].
    seed : int
        Seed of the random numbers, 0 to 2^64 - 1.
    transport : Transport, optional
        Model of the transport, of which diffusion, steps and back surface count.  Without a width
        the diffusion is Einstein's: that of a device, found on such clusters, holds their repulsion.
    repulsion : float
        Strength of the repulsion relative to Coulomb's law in silicon, 0 or more; 0 switches it off.
    softening : float, optional
        Distance within which the force of a pair is softened [um]; all pairs are summed then.  By
        default electrons feel the charge nearer to the middle, which is exact for a round cloud
        and n / log n times cheaper.

    Returns
    -------
    electrons : Electrons
        Last positions, pixels and fates.

    Raises
    ------
    DeviceError
        A start is not a number, or not in the silicon.
    SimulationError
        The repulsion is negative or not finite.
    ConvergenceError
        An electron found no well.

    Examples
    --------
    >>> from bfsensor import Device
    >>> from bfsensor.simulate.unit_cell import solve_unit_cell
    >>> tracer = Tracer(solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8))
    >>> trace_cloud(tracer, [[1.0, 0.0, 60.0]], seed=8231, repulsion=-1.0)
    Traceback (most recent call last):
        ...
    bfsensor.errors.SimulationError: repulsion = -1.0 must be 0 or more
    """
    transport = transport or Transport()
    if not (np.isfinite(repulsion) and repulsion >= 0):
        raise SimulationError(f"repulsion = {repulsion} must be 0 or more")
    starts, room, kt = tracer.prepare(starts, transport)
    count = len(starts)
    device = tracer.potential.device
    permittivity = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    width = 1.0 if transport.diffusion is None else float(transport.diffusion)
    pace = transport_kernels.Pace(
        float(transport.part),
        float(transport.shortest),
        float(transport.longest),
        _MOST_STEPS,
    )
    out = np.empty((count, 3))
    fates = np.empty(count, np.int64)
    kernels.drift_together(
        *tracer.field_arrays, room, pace, kt * width**2,
        silicon.mobility_law(device.operating_point.temperature),
        float(repulsion) / (4 * np.pi * permittivity),
        -1.0 if softening is None else float(softening), starts,
        np.arange(count, dtype=np.uint64), np.uint32(seed & 0xFFFFFFFF),
        np.uint32(seed >> 32 & 0xFFFFFFFF), out, fates,
    )  # fmt: skip
    if (fates == transport_kernels.LOST).any():
        raise ConvergenceError(
            f"{np.count_nonzero(fates == transport_kernels.LOST)} of {count} electrons of a cloud "
            f"found no well in {_MOST_STEPS} steps",
            [],
        )
    return Electrons(out, tracer.pixels_of(out), fates)
