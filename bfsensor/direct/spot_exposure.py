"""Spots of the direct simulation: plans, simulation, results and their files."""

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
"""Name and version of the file format."""

_SPOT_STREAM = 0x5B0750
"""Third word of the seed of a spot, which keeps its numbers apart from those of a flat.

Chosen: any other number gives other random numbers of the same distribution."""


@dataclass(frozen=True)
class SpotPlan(ExposurePlan):
    """Settings of spots that are built up alike and differ in their centres and electrons alone.

    Parameters
    ----------
    device : Device
        Sensor at its operating point, fully depleted.
    peak : float
        Electrons that the brightest pixel of a spot centred on it would collect without
        diffusion [e-], from 1 to 1e7 and at most the full well (:meth:`check_full_well`).
    sigma : float
        Standard deviation of the spot at the back surface along an axis [um], 0.1 to 1000; the
        array must hold 3 sigma on either side and the central pixel.
    steps : int
        Number of equal steps of charge, 1 to 100,000, before each of which the field is solved.
    pixels : int
        Period of the array [pixel], odd, 3 to 63; every well is filled by what it collects.
    cells : int
        Mesh cells per pixel in x and in y, even, 8 to 64.
    depth : float, optional
        Height of conversion above the gates [um], from 2 to the thickness; by default 5 um below
        the back surface, as in the published simulations.
    wavelength : float, optional
        Wavelength of the light [nm], in place of ``depth``: heights are drawn from the absorption
        length.
    transport : Transport
        Model of drift and diffusion.
    seed : int
        Seed of all random numbers, 0 to 2^63; spots differ by their number.

    Attributes
    ----------
    electrons : int
        Number of electrons of a whole spot.
    step_ends : ndarray of int, shape (steps + 1,)
        Number of electrons that have come after each step, from 0 before the first.
    conversion_height : float
        Height of conversion above the gates [um].
    key : str
        Digest of the device and all settings.

    Raises
    ------
    DeviceError
        A value lies outside its limits, or the device is not fully depleted.

    Examples
    --------
    >>> from bfsensor import Device
    >>> SpotPlan(Device.load("itl_sta3800c"), peak=50_000.0, sigma=8.0).electrons
    228257
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
        """Refuse values outside their limits."""
        limits = {"peak": (1.0, 1e7), "sigma": (0.1, 1000.0)}
        if self.wavelength is not None:
            # The range in which silicon's absorption is known.
            limits["wavelength"] = (250.0, 1450.0)
        self._check(**limits)
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
        """Number of electrons of a whole spot."""
        share = 1.0
        for pitch in (self.device.pixel.pitch_x, self.device.pixel.pitch_y):
            share *= float(erf(pitch / 2 / (np.sqrt(2) * self.sigma)))
        return round(self.peak / share)

    @property
    def step_ends(self) -> NDArray[np.int64]:
        """Number of electrons that have come after each step, from 0 before the first."""
        return step_ends(self.electrons, self.steps)


@dataclass(frozen=True)
class Spot:
    """A simulated spot after each step of charge, with the brighter-fatter effect and without.

    Parameters
    ----------
    number : int
        Number of the spot in its plan, from 0.
    centre : tuple of float
        Centre of the light (x, y) from the middle of the central pixel [um].
    on, off : ndarray, shape (steps, pixels, pixels)
        Electrons collected up to the end of each step, as images [y, x] [e-]; ``off`` with the
        field of the empty sensor.
    key : str
        Key of the plan.
    cpu_seconds : float
        CPU time of the simulation [s].
    """

    number: int
    centre: tuple[float, float]
    on: NDArray[np.int32] = field(repr=False)
    off: NDArray[np.int32] = field(repr=False)
    key: str
    cpu_seconds: float

    def write(self, path: str | Path) -> None:
        """Write the spot to a FITS file, whole or not at all.

        Parameters
        ----------
        path : path-like
            File to write; one that exists is replaced.

        Raises
        ------
        SimulationError
            The file cannot be written.
        """
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
        """Read a spot that :meth:`write` wrote.

        Parameters
        ----------
        path : path-like
            File to read.

        Returns
        -------
        spot : Spot
            Spot of the file.

        Raises
        ------
        SimulationError
            The file is not a spot of the direct simulation, or is damaged.
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
        Settings of the simulation.
    number : int
        Number of the spot, from 0; it selects the centre within the central pixel and the random
        numbers of the electrons.
    progress : callable, optional
        Function that is called with the number of the step just finished, from 1.

    Returns
    -------
    spot : Spot
        The same bits for the same plan and number.

    Raises
    ------
    SimulationError
        The peak is above the full well, see :meth:`SpotPlan.check_full_well`.
    ConvergenceError
        A potential did not converge, or an electron found no well.
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
    """Draw the centre of a spot and the positions where its light sets electrons free.

    Parameters
    ----------
    plan : SpotPlan
        Settings of the simulation.
    number : int
        Number of the spot in its plan, from 0.
    electrons : ndarray of int, shape (n,)
        Consecutive numbers of the electrons, from 0.

    Returns
    -------
    centre : tuple of float
        Centre (x, y) from the middle of the central pixel [um].
    starts : ndarray, shape (n, 3)
        Positions (x, y, z) where the electrons are set free [um].

    Examples
    --------
    >>> from bfsensor import Device
    >>> plan = SpotPlan(Device.load("itl_sta3800c"))
    >>> centre, starts = spot_electrons(plan, 0, np.arange(100))
    >>> bool(max(abs(c) for c in centre) < 5.0), starts.shape
    (True, (100, 3))
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
    """Positions where the light of a Gaussian spot sets electrons free [um]."""
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
    # Light that crosses the silicon is not collected: depths are drawn from the exponential
    # truncated at LOWEST, so that the number of electrons stays that of the plan.
    lowest = np.exp(-(thickness - light.LOWEST) / length)
    uniform = np.exp(-light.paths(numbers, seed=seed))
    out[:, 2] = thickness + length * np.log(lowest + uniform * (1.0 - lowest))
    return out
