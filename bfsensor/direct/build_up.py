"""Build-up of an exposure electron by electron, the charge fed back into Poisson's equation.

A spot is built up in steps (Lage, Bradshaw & Tyson 2017, section 4): solve for the charge
that is there, send the next electrons through that field, add them to the wells they
reach, solve again.  The same electrons, with the same random numbers, also go through the
field of the empty sensor: differences between both images are the brighter-fatter effect,
with a fraction of the noise of either.  Flats are compared with the field of evenly filled wells
instead: the difference is the effect of the pixels' unequal charges alone.

The charge that the field is solved for is that of the middle of the step, half of what
the step brings to the empty sensor added: without it the field lags behind the charge by
half a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from bfsensor.direct.transport import ABSORBED, Electrons, Tracer, Transport
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

TOLERANCE = 1e-4
"""Iteration error of the potential of a step [V].

Chosen: 3 % of the change that 100 electrons make in the level of a well, which falls by some 3e-5 V
per electron; twice as large, the error is that of 7 electrons."""


def build_up(
    device: Device,
    step_ends: NDArray[np.int64],
    starts: Callable[[NDArray[np.int64]], FloatArray],
    *,
    pixels: int,
    cells: int,
    transport: Transport,
    seed: int,
    reference: Literal["empty", "even"] = "empty",
    progress: Callable[[int], None] | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Collect electrons step by step, with the charge fed back and without.

    Parameters
    ----------
    device : Device
        Sensor at its operating point.
    step_ends : ndarray of int, shape (steps + 1,)
        Number of electrons that have come before the first and after each step, from 0.
    starts : callable
        Function from consecutive electron numbers to the positions (x, y, z) where they are set
        free, shape (n, 3) [um].
    pixels, cells : int
        Period of the array [pixel], odd, and mesh cells per pixel.
    transport : Transport
        Model of drift and diffusion.
    seed : int
        Seed of the electrons' random numbers.
    reference : {'empty', 'even'}
        Field without the effect: that of the empty sensor, or in each step that of wells that all
        hold the mean charge.
    progress : callable, optional
        Function that is called with the number of the step just finished, from 1.

    Returns
    -------
    on, off : ndarray, shape (steps, pixels, pixels)
        Electrons collected up to the end of each step, with the effect and without, as
        images [y, x].

    Raises
    ------
    ConvergenceError
        A potential did not converge, or an electron found no well.
    """
    sensor = Sensor(device, pixels, cells)
    solver, empty, plain_tracer = empty_sensor(sensor)
    steps, shape = len(step_ends) - 1, (pixels, pixels)
    on = np.zeros((steps, *shape), np.int32)
    off = np.zeros_like(on)
    collected = np.zeros(shape, np.int64)
    plain_sum = np.zeros(shape, np.int64)
    past: list[FloatArray] = []
    for step in range(steps):
        numbers = np.arange(step_ends[step], step_ends[step + 1])
        places = starts(numbers)
        if reference == "even":
            solved = _solve_even(sensor, solver, empty, collected, numbers.size)
            plain_tracer = Tracer(solved)
        plain = plain_tracer.trace(places, seed=seed, numbers=numbers, transport=transport)
        plain_image = _image(plain, pixels)
        start = empty.phi if not past else past[-1]
        if len(past) == 2:
            # Charge grows in equal steps and the potential nearly so: a linear extrapolation
            # saves Newton steps and leaves the solution as it is, within its tolerance.
            start = 2.0 * past[-1] - past[-2]
        potential = solver.solve(
            collected + 0.5 * plain_image, start=start, tolerance=TOLERANCE
        )
        past = [*past[-1:], potential.phi]
        electrons = Tracer(potential).trace(
            places, seed=seed, numbers=numbers, transport=transport
        )
        collected += _image(electrons, pixels)
        plain_sum += plain_image
        on[step] = collected
        off[step] = plain_sum
        if progress is not None:
            progress(step + 1)
    return on, off


@dataclass(frozen=True, eq=False)
class Sensor:
    """A device on a mesh, hashable by the device's text, as a key of the cache below."""

    device: Device
    pixels: int
    cells: int

    def __hash__(self) -> int:
        return hash((self.device.to_toml(), self.pixels, self.cells))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sensor) and (
            (self.device.to_toml(), self.pixels, self.cells)
            == (other.device.to_toml(), other.pixels, other.cells)
        )


@lru_cache(maxsize=2)
def empty_sensor(sensor: Sensor) -> tuple[Electrostatics, Potential, Tracer]:
    """Solver, potential and tracer of the sensor without charge; cached for two sensors."""
    mesh = make_mesh(
        sensor.device, pixels=(sensor.pixels, sensor.pixels), cells=sensor.cells,
        symmetric=False,
    )  # fmt: skip
    solver = Electrostatics(sensor.device, mesh)
    start = None
    if sensor.device.is_mirror_symmetric:
        start = tile(solve_unit_cell(sensor.device, 0.0, cells=sensor.cells), mesh)
    empty = solver.solve(0.0, start=start, tolerance=TOLERANCE)
    return solver, empty, Tracer(empty)


def _solve_even(
    sensor: Sensor,
    solver: Electrostatics,
    empty: Potential,
    collected: NDArray[np.int64],
    coming: int,
) -> Potential:
    """Solve for wells that all hold the mean charge of the middle of a step."""
    mean = float(collected.mean()) + 0.5 * coming / collected.size
    start = empty.phi
    if sensor.device.is_mirror_symmetric:
        start = tile(solve_unit_cell(sensor.device, mean, cells=sensor.cells), solver.mesh)
    return solver.solve(mean, start=start, tolerance=TOLERANCE)


def _image(electrons: Electrons, pixels: int) -> NDArray[np.int64]:
    """Count electrons by pixel, as an image [y, x]; the array is periodic."""
    index = (electrons.pixels[electrons.fates != ABSORBED] + pixels // 2) % pixels
    return np.bincount(
        index[:, 1] * pixels + index[:, 0], minlength=pixels * pixels
    ).reshape(pixels, pixels)
