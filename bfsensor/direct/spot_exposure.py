"""Spots of the direct simulation: what to build up, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from bfsensor.device import silicon
from bfsensor.direct import light
from bfsensor.direct.exposure_plan import (
    ExposurePlan,
    expose,
    read_exposure,
    step_ends,
    write_exposure,
)
from bfsensor.direct.transport import Transport
from bfsensor.errors import DeviceError
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

SCHEMA = "bfsensor spot 1"
_SPOT_STREAM = 0x5B0750


@dataclass(frozen=True)
class SpotPlan(ExposurePlan):
    """Spots to be built up, all alike but for their centres and their electrons.

    Parameters
    ----------
    device : Device
        The sensor at its operating point.
    peak : float
        Electrons that the brightest pixel of a spot centred on it would get without
        diffusion [e-].  At most the full well (:meth:`check_full_well`).
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

    KIND: ClassVar[str] = "spots"
    SCHEMA: ClassVar[str] = SCHEMA
    KEYED: ClassVar[tuple[str, ...]] = (
        "peak", "sigma", "steps", "pixels", "cells", "depth", "wavelength", "transport", "seed",
    )  # fmt: skip
    CHARGE: ClassVar[str] = "peak"

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
        self._check(peak=(1.0, 1e7), sigma=(0.1, 1000.0))
        pitch = max(self.device.pixel.pitch_x, self.device.pixel.pitch_y)
        if self.pixels * pitch < 6.0 * self.sigma + pitch:
            raise DeviceError(
                f"spots: sigma = {self.sigma:g} um is too wide for {self.pixels} pixels: the array "
                f"is periodic, and must hold 3 sigma on either side and the central pixel"
            )
        if self.wavelength is not None and self.depth is not None:
            raise DeviceError("spots: give a depth or a wavelength, not both")

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
        return step_ends(self.electrons, self.steps)


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
        cards = {
            "SPOT": (self.number, "number of the spot in its plan"),
            "CENTRE_X": (self.centre[0], "[um] from the middle of the central pixel"),
            "CENTRE_Y": (self.centre[1], "[um]"),
            "PLANKEY": (self.key, "of the plan"),
            "CPU_S": (round(self.cpu_seconds, 2), "[s]"),
        }
        write_exposure(path, SCHEMA, cards, self.on, self.off)

    @classmethod
    def read(cls, path: str | Path) -> Spot:
        """Read what :meth:`write` wrote.

        Raises
        ------
        SimulationError
            Not such a file, or damaged.
        """
        kinds = {
            "SPOT": int, "CENTRE_X": float, "CENTRE_Y": float, "PLANKEY": str, "CPU_S": float,
        }  # fmt: skip
        cards, on, off = read_exposure(
            path, SCHEMA, kinds, "a spot of the direct simulation"
        )
        centre = cards["CENTRE_X"], cards["CENTRE_Y"]
        return cls(cards["SPOT"], centre, on, off, cards["PLANKEY"], cards["CPU_S"])


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
    SimulationError
        The peak is above the full well, see :meth:`SpotPlan.check_full_well`.
    ConvergenceError
        From the solver or the tracer.
    """
    centre, seed = _choose(plan, number)
    found = expose(
        plan, plan.electrons, lambda numbers: _starts(plan, seed, numbers, centre),
        seed=seed, progress=progress,
    )  # fmt: skip
    at = float(centre[0]), float(centre[1])
    return Spot(number, at, found.on, found.off, plan.key, found.cpu_seconds)


def spot_electrons(
    plan: SpotPlan, number: int, electrons: NDArray[np.int64]
) -> tuple[tuple[float, float], FloatArray]:
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


def _choose(plan: SpotPlan, number: int) -> tuple[FloatArray, int]:
    """Centre of a spot [um] and the seed of its electrons."""
    pitch = np.array([plan.device.pixel.pitch_x, plan.device.pixel.pitch_y])
    rng = np.random.default_rng([plan.seed, number, _SPOT_STREAM])
    centre = (rng.random(2) - 0.5) * pitch
    return centre, int(rng.integers(2**63))


def _starts(
    plan: SpotPlan, seed: int, numbers: NDArray[np.int64], centre: FloatArray
) -> FloatArray:
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
