"""Spots of the direct simulation: what to build up, and what comes of it."""

from __future__ import annotations

import hashlib
import io
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.special import erf

from bfsensor import silicon
from bfsensor.errors import DeviceError, SimulationError
from bfsensor.files import written_whole
from bfsensor.simulate import light
from bfsensor.simulate.build_up import build_up
from bfsensor.simulate.transport import Transport

if TYPE_CHECKING:
    from bfsensor.device import Device

SCHEMA = "bfsensor spot 1"
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
        diffusion [e-].  Below the full well, which ``bfsensor spots`` checks: the field is
        solved for any charge, and electrons that spill are not followed.
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
        with written_whole(path, SimulationError) as beside:
            hdus.writeto(beside, overwrite=True, checksum=True)

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
    centre, seed = _choose(plan, number)
    on, off = build_up(
        plan.device, plan.step_ends,
        lambda numbers: _starts(plan, seed, numbers, centre), pixels=plan.pixels,
        cells=plan.cells, transport=plan.transport, seed=seed, progress=progress,
    )  # fmt: skip
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
