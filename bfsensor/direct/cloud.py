r"""Clouds of electrons that X-rays set free: they repel one another on their way.

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
"""Attenuation length of 5.9 keV photons in silicon [um]: an estimate, good to some 5 %, from a mass
attenuation near 150 cm^2/g (published simulations: 30 um)."""

_MOST_STEPS = 20_000


def fe55_cloud(
    *, seed: int, place: tuple[float, float], thickness: float, radius: float = 0.2,
    electrons: int = FE55_ELECTRONS, height: float | None = None,
) -> FloatArray:  # fmt: skip
    """Draw the electrons of one X-ray photon that comes through the back surface.

    Parameters
    ----------
    seed : int
        Of the random numbers.
    place : tuple of float
        (x, y) [um].
    thickness : float
        Of the silicon [um].
    radius : float
        Rms radius of the cloud along an axis [um]; 0.2 as in the published simulations.
    electrons : int
        How many.
    height : float, optional
        Of the middle above the gates [um]; by default drawn from the attenuation length.

    Returns
    -------
    starts : ndarray, shape (electrons, 3)
        [um], within the silicon from 2 um above the gates.
    """
    if not (radius > 0 and electrons >= 1):
        raise SimulationError(
            f"a cloud needs a radius above 0 and electrons, not {radius} um and {electrons}"
        )
    rng = np.random.default_rng([seed, 55])
    if height is None:
        lowest = np.exp(-(thickness - 4.0) / FE55_LENGTH)
        height = thickness + FE55_LENGTH * float(
            np.log(lowest + rng.random() * (1 - lowest))
        )
    starts = rng.normal((*place, height), radius, (electrons, 3))
    # What the surfaces cut off is folded back.
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
        Of the solved field.
    starts : array_like, shape (n, 3)
        Where they are set free, at the same time [um].
    seed : int
        Of the random numbers.
    transport : Transport, optional
        Its diffusion, steps and back surface.
    repulsion : float
        Relative to Coulomb's law in silicon; 0 switches it off.
    softening : float, optional
        Sum over all pairs, softened within this distance [um]; by default the sum over
        shells, exact for a cloud that is round, and n / log n times cheaper.

    Returns
    -------
    Electrons

    Raises
    ------
    SimulationError
        A repulsion that is negative.
    ConvergenceError
        Electrons that found no well.
    """
    transport = transport or Transport()
    if not (np.isfinite(repulsion) and repulsion >= 0):
        raise SimulationError(f"repulsion = {repulsion} must be 0 or more")
    starts, room, kt = tracer.prepare(starts, transport)
    count = len(starts)
    device = tracer.potential.device
    permittivity = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    pace = transport_kernels.Pace(
        float(transport.part),
        float(transport.shortest),
        float(transport.longest),
        _MOST_STEPS,
    )
    out = np.empty((count, 3))
    fates = np.empty(count, np.int64)
    kernels.drift_together(
        *tracer.field_arrays, room, pace, kt * transport.diffusion**2,
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
