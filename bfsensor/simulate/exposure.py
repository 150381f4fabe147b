"""The direct simulation: electrons one by one, charge fed back into Poisson's equation.

A spot is built up in steps (Lage, Bradshaw & Tyson 2017, section 4): solve for the charge
that is there, send the next electrons through that field, add them to the wells they
reach, solve again.  The same electrons, with the same random numbers, also go through the
field of the empty sensor: differences between both images are the brighter-fatter effect,
with a fraction of the noise of either.

The charge that the field is solved for is that of the middle of the step, half of what
the step brings to the empty sensor added: without it the field lags behind the charge by
half a step.
"""

from __future__ import annotations

import hashlib
import io
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.special import erf

from bfsensor import silicon
from bfsensor.errors import DeviceError, SimulationError
from bfsensor.simulate import light
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential, solve_unit_cell, tile
from bfsensor.simulate.transport import ABSORBED, Electrons, Tracer, Transport

if TYPE_CHECKING:
    from bfsensor.device import Device

SCHEMA = "bfsensor spot 1"
TOLERANCE = 1e-4
"""Iteration error [V] of a step's field: 1 % of what 100 electrons in a pixel do to it."""

_SPOT_STREAM = 0x5B0750


@dataclass(frozen=True)
class SpotPlan:
    """Spots to be built up, all alike but for their centres and their electrons.

    Parameters
    ----------
    device : Device
        The sensor at its operating point.
    peak : float
        Electrons that the brightest pixel of a spot centred on it would get without
        diffusion [e-].
    sigma : float
        Width of the spot at the back surface [um].
    steps : int
        Equal steps of charge, after each of which the field is solved again.
    pixels : int
        Period of the array [pixel], odd; every well is filled by what it collects.
    cells : int
        Mesh cells a pixel.
    depth : float, optional
        Height of conversion above the gates [um]; by default 5 um below the back surface,
        as in the published simulations.
    wavelength : float, optional
        Of the light [nm]: heights are drawn from the absorption length instead.
    transport : Transport
        How electrons move.
    seed : int
        Chooses all random numbers; spots differ by their number.

    Raises
    ------
    DeviceError
        A value that makes no sense, by name.
    """

    device: Device
    peak: float = 80_000.0
    sigma: float = 10.0
    steps: int = 80
    pixels: int = 13
    cells: int = 8
    depth: float | None = None
    wavelength: float | None = None
    transport: Transport = field(default_factory=Transport)
    seed: int = 20170

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        thickness = self.device.silicon.thickness
        checks = (
            ("peak", self.peak, 1.0, 1e7),
            ("sigma", self.sigma, 0.1, 1000.0),
            ("steps", self.steps, 1, 100_000),
            ("pixels", self.pixels, 3, 63),
            ("cells", self.cells, 8, 64),
            ("depth", self.conversion_height, 2.0, thickness),
            ("seed", self.seed, 0, 2**63),
        )
        for name, value, low, high in checks:
            if not low <= value <= high:
                raise DeviceError(
                    f"spots: {name} = {value:g} must be from {low:g} to {high:g}"
                )
        if self.pixels % 2 == 0:
            raise DeviceError(
                f"spots: pixels = {self.pixels} must be odd: one is in the middle"
            )
        pitch = max(self.device.pixel.pitch_x, self.device.pixel.pitch_y)
        if self.pixels * pitch < 6.0 * self.sigma + pitch:
            raise DeviceError(
                f"spots: sigma = {self.sigma:g} um is too wide for {self.pixels} pixels: the array "
                f"is periodic, and must hold 3 sigma on either side and the central pixel"
            )
        if self.wavelength is not None and self.depth is not None:
            raise DeviceError("spots: give a depth or a wavelength, not both")

    @property
    def conversion_height(self) -> float:
        """Height of conversion [um] where no wavelength is given."""
        return self.device.silicon.thickness - 5.0 if self.depth is None else self.depth

    @property
    def electrons(self) -> int:
        """Electrons in a whole spot."""
        share = 1.0
        for pitch in (self.device.pixel.pitch_x, self.device.pixel.pitch_y):
            share *= float(erf(pitch / 2 / (np.sqrt(2) * self.sigma)))
        return round(self.peak / share)

    @property
    def step_ends(self) -> NDArray[np.int64]:
        """How many electrons have come after each step, from 0 before the first."""
        return np.round(np.linspace(0, self.electrons, self.steps + 1)).astype(np.int64)

    @property
    def key(self) -> str:
        """What tells the results of one plan from those of another."""
        text = "\n".join([
            SCHEMA, self.device.to_toml(), *(
                f"{name}={getattr(self, name)!r}"
                for name in (
                    "peak", "sigma", "steps", "pixels", "cells", "depth", "wavelength",
                    "transport", "seed",
                )
            ),
        ])  # fmt: skip
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Spot:
    """A spot as it grew, with the effect and without.

    Attributes
    ----------
    number : int
        Of the spot in its plan.
    centre : tuple of float
        Of the light (x, y) [um] from the middle of the central pixel.
    on, off : ndarray, shape (steps, pixels, pixels)
        Electrons collected up to the end of each step, as images [y, x] [e-].
    key : str
        Of the plan.
    cpu_seconds : float
        What it took.
    """

    number: int
    centre: tuple[float, float]
    on: NDArray[np.int32] = field(repr=False)
    off: NDArray[np.int32] = field(repr=False)
    key: str
    cpu_seconds: float

    def write(self, path: str | Path) -> None:
        """Write to FITS, whole or not at all."""
        path = Path(path)
        header = fits.Header()
        header["SCHEMA"] = SCHEMA
        header["SPOT"] = (self.number, "number of the spot in its plan")
        header["CENTRE_X"] = (self.centre[0], "[um] from the middle of the central pixel")
        header["CENTRE_Y"] = (self.centre[1], "[um]")
        header["PLANKEY"] = (self.key, "of the plan")
        header["CPU_S"] = (round(self.cpu_seconds, 2), "[s]")
        hdus = fits.HDUList([
            fits.PrimaryHDU(header=header), fits.ImageHDU(self.on, name="ON"),
            fits.ImageHDU(self.off, name="OFF"),
        ])  # fmt: skip
        for hdu in hdus[1:]:
            hdu.header["BUNIT"] = "electron"
        part = path.with_name(path.name + ".part")
        hdus.writeto(part, overwrite=True, checksum=True)
        part.replace(path)

    @classmethod
    def read(cls, path: str | Path) -> Spot:
        """Read what :meth:`write` wrote.

        Raises
        ------
        SimulationError
            Not such a file, or damaged.
        """
        # From memory: a damaged file would else stay open.
        content = io.BytesIO(Path(path).read_bytes())
        try:
            with warnings.catch_warnings(), fits.open(content, checksum=True) as hdus:
                warnings.simplefilter("error")  # checksums
                header = hdus[0].header
                if header.get("SCHEMA") != SCHEMA:
                    raise SimulationError(f"{path}: not a spot of the direct simulation")
                return cls(
                    number=int(header["SPOT"]),
                    centre=(float(header["CENTRE_X"]), float(header["CENTRE_Y"])),
                    on=hdus["ON"].data.astype(np.int32),
                    off=hdus["OFF"].data.astype(np.int32),
                    key=str(header["PLANKEY"]),
                    cpu_seconds=float(header["CPU_S"]),
                )
        except (OSError, KeyError, TypeError, ValueError, UserWarning) as error:
            if isinstance(error, SimulationError):
                raise
            raise SimulationError(
                f"{path}: not a spot of the direct simulation, or damaged"
            ) from error


def simulate_spot(
    plan: SpotPlan, number: int, *, progress: Callable[[int], None] | None = None
) -> Spot:
    """Build up one spot.

    Parameters
    ----------
    plan : SpotPlan
        What to simulate.
    number : int
        Of the spot, from 0: chooses its centre within the central pixel and its electrons.
    progress : callable, optional
        Called with the number of the step that is done.

    Returns
    -------
    Spot
        The same bits for the same plan and number.

    Raises
    ------
    ConvergenceError
        From the solver or the tracer.
    """
    begin = time.process_time()
    solver, empty, empty_tracer = _empty_sensor(
        _Sensor(plan.device, plan.pixels, plan.cells)
    )
    centre, seed = _choose(plan, number)
    shape = (plan.pixels, plan.pixels)
    edges = plan.step_ends
    on = np.zeros((plan.steps, *shape), np.int32)
    off = np.zeros_like(on)
    collected = np.zeros(shape, np.int64)
    reference = np.zeros(shape, np.int64)
    past: list[NDArray[np.float64]] = []
    for step in range(plan.steps):
        numbers = np.arange(edges[step], edges[step + 1])
        starts = _starts(plan, seed, numbers, centre)
        plain = empty_tracer.trace(
            starts, seed=seed, numbers=numbers, transport=plan.transport
        )
        plain_image = _image(plain, plan.pixels)
        start = empty.phi if not past else past[-1]
        if len(past) == 2:
            # Charge grows steadily, and so does its potential.
            start = 2.0 * past[-1] - past[-2]
        potential = solver.solve(
            collected + 0.5 * plain_image, start=start, tolerance=TOLERANCE
        )
        past = [*past[-1:], potential.phi]
        electrons = Tracer(potential).trace(
            starts, seed=seed, numbers=numbers, transport=plan.transport
        )
        collected += _image(electrons, plan.pixels)
        reference += plain_image
        on[step] = collected
        off[step] = reference
        if progress is not None:
            progress(step + 1)
    return Spot(
        number, (float(centre[0]), float(centre[1])), on, off, plan.key,
        time.process_time() - begin,
    )  # fmt: skip


def spot_electrons(
    plan: SpotPlan, number: int, electrons: NDArray[np.int64]
) -> tuple[tuple[float, float], NDArray[np.float64]]:
    """Give the centre of a spot and where its light sets electrons free.

    Parameters
    ----------
    plan, number
        As for :func:`simulate_spot`.
    electrons : ndarray of int, shape (n,)
        Consecutive numbers of the electrons.

    Returns
    -------
    centre : tuple of float
        (x, y) [um] from the middle of the central pixel.
    starts : ndarray, shape (n, 3)
        [um].
    """
    centre, seed = _choose(plan, number)
    return (float(centre[0]), float(centre[1])), _starts(plan, seed, electrons, centre)


def _choose(plan: SpotPlan, number: int) -> tuple[NDArray[np.float64], int]:
    """Centre of a spot [um] and the seed of its electrons."""
    pitch = np.array([plan.device.pixel.pitch_x, plan.device.pixel.pitch_y])
    rng = np.random.default_rng([plan.seed, number, _SPOT_STREAM])
    centre = (rng.random(2) - 0.5) * pitch
    return centre, int(rng.integers(2**63))


@dataclass(frozen=True, eq=False)
class _Sensor:
    """A device on a mesh, known by its text."""

    device: Device
    pixels: int
    cells: int

    def __hash__(self) -> int:
        return hash((self.device.to_toml(), self.pixels, self.cells))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Sensor) and (
            (self.device.to_toml(), self.pixels, self.cells)
            == (other.device.to_toml(), other.pixels, other.cells)
        )


@lru_cache(maxsize=2)
def _empty_sensor(sensor: _Sensor) -> tuple[Electrostatics, Potential, Tracer]:
    """Solve the sensor without charge, once a process."""
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


def _starts(
    plan: SpotPlan, seed: int, numbers: NDArray[np.int64], centre: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where the light sets electrons free [um]: a Gaussian spot."""
    out = np.empty((len(numbers), 3))
    out[:, :2] = light.spot(
        numbers, seed=seed, centre=(centre[0], centre[1]), sigma=plan.sigma
    )
    if plan.wavelength is None:
        out[:, 2] = plan.conversion_height
        return out
    thickness = plan.device.silicon.thickness
    length = float(
        silicon.absorption_length(plan.wavelength, plan.device.operating_point.temperature)
    )
    # Light that crosses the silicon is not collected: depths are those of the rest.
    lowest = np.exp(-(thickness - light.LOWEST) / length)
    uniform = np.exp(-light.paths(numbers, seed=seed))
    out[:, 2] = thickness + length * np.log(lowest + uniform * (1.0 - lowest))
    return out


def _image(electrons: Electrons, pixels: int) -> NDArray[np.int64]:
    """Count electrons by pixel, as an image [y, x]; the array is periodic."""
    index = (electrons.pixels[electrons.fates != ABSORBED] + pixels // 2) % pixels
    return np.bincount(
        index[:, 1] * pixels + index[:, 0], minlength=pixels * pixels
    ).reshape(pixels, pixels)
