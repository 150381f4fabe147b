"""Flats of the direct simulation: even light on the whole period, charge fed back.

A period holds few pixels; its covariances come from many flats.  The same electrons also go
through wells that all hold the mean charge, where charges of pixels are independent: the
difference of both images is the effect of the pixels' unequal charges, and
:func:`~bfsensor.measure.pixel_response.measure_response` finds from it the response of the areas of
neighbouring pixels to one electron.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from bfsensor.direct import light
from bfsensor.direct.exposure_plan import (
    ExposurePlan,
    expose,
    read_exposure,
    write_exposure,
)
from bfsensor.direct.transport import Transport
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

SCHEMA = "bfsensor flat 2"
"""Name and version of the file format."""

_FLAT_STREAM = 0xF1A7
"""Third word of the seed of a flat, which keeps its numbers apart from those of a spot.

Chosen: any other number gives other random numbers of the same distribution."""


@dataclass(frozen=True)
class FlatPlan(ExposurePlan):
    """Settings of flats that are built up alike and differ in their electrons alone.

    Parameters
    ----------
    device : Device
        Sensor at its operating point, fully depleted.
    level : float
        Mean number of electrons per pixel at the end [e-], from 1 to 1e6 and at most the full well
        (:meth:`check_full_well`).
    steps : int
        Number of equal steps of charge, 1 to 100,000, before each of which the field is solved.
    pixels : int
        Period of the array [pixel], odd, 3 to 63.
    cells : int
        Mesh cells per pixel in x and in y, even, 8 to 64.
    depth : float, optional
        Height of conversion above the gates [um], from 2 to the thickness; by default 5 um below
        the back surface.
    transport : Transport
        Model of drift and diffusion.
    seed : int
        Seed of all random numbers, 0 to 2^63; flats differ by their number.

    Attributes
    ----------
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
    >>> FlatPlan(Device.load("itl_sta3800c"), level=40_000.0).conversion_height
    95.0
    """

    KIND: ClassVar[str] = "flats"
    SCHEMA: ClassVar[str] = SCHEMA
    KEYED: ClassVar[tuple[str, ...]] = (
        "level", "steps", "pixels", "cells", "depth", "transport", "seed",
    )  # fmt: skip
    CHARGE: ClassVar[str] = "level"

    device: Device
    level: float = 80_000.0
    steps: int = 20
    pixels: int = 13
    cells: int = 8
    depth: float | None = None
    transport: Transport = field(default_factory=Transport)
    seed: int = 20171

    def __post_init__(self) -> None:
        """Refuse values outside their limits."""
        self._check(level=(1.0, 1e6))


@dataclass(frozen=True)
class Flat:
    """A simulated flat after each step of charge, with the brighter-fatter effect and without.

    Parameters
    ----------
    number : int
        Number of the flat in its plan, from 0.
    on, off : ndarray, shape (steps, pixels, pixels)
        Electrons collected up to the end of each step, as periodic images [y, x] [e-]; ``off``
        with evenly filled wells.
    cpu_seconds : float
        CPU time of the simulation [s].
    key : str
        Key of the plan; empty where it is not known.
    """

    number: int
    on: NDArray[np.int32] = field(repr=False)
    off: NDArray[np.int32] = field(repr=False)
    cpu_seconds: float
    key: str = ""

    def write(self, path: str | Path) -> None:
        """Write the flat to a FITS file, whole or not at all.

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
            "FLAT": (self.number, "number of the flat in its plan"),
            "PLANKEY": (self.key, "of the plan"),
            "CPU_S": (round(self.cpu_seconds, 2), "[s]"),
        }
        write_exposure(path, SCHEMA, cards, self.on, self.off)

    @classmethod
    def read(cls, path: str | Path) -> Flat:
        """Read a flat that :meth:`write` wrote.

        Parameters
        ----------
        path : path-like
            File to read.

        Returns
        -------
        flat : Flat
            Flat of the file.

        Raises
        ------
        SimulationError
            The file is not a flat of the direct simulation, or is damaged.
        """
        kinds = {"FLAT": int, "PLANKEY": str, "CPU_S": float}
        cards, on, off = read_exposure(
            path, SCHEMA, kinds, "a flat of the direct simulation"
        )
        return cls(cards["FLAT"], on, off, cards["CPU_S"], cards["PLANKEY"])


def simulate_flat(
    plan: FlatPlan, number: int, *, progress: Callable[[int], None] | None = None
) -> Flat:
    """Build up one flat.

    Parameters
    ----------
    plan : FlatPlan
        Settings of the simulation.
    number : int
        Number of the flat, from 0; it selects the random numbers of its electrons and their count.
    progress : callable, optional
        Function that is called with the number of the step just finished, from 1.

    Returns
    -------
    flat : Flat
        The same bits for the same plan and number.  The electrons of a whole period are a
        Poisson number.

    Raises
    ------
    SimulationError
        The level is above the full well, see :meth:`FlatPlan.check_full_well`.
    ConvergenceError
        A potential did not converge, or an electron found no well.
    """
    rng = np.random.default_rng([plan.seed, number, _FLAT_STREAM])
    seed = int(rng.integers(2**63))
    total = int(rng.poisson(plan.level * plan.pixels**2))
    pixel = plan.device.pixel
    half = plan.pixels / 2
    box = (-half * pixel.pitch_x, half * pixel.pitch_x, -half * pixel.pitch_y,
           half * pixel.pitch_y)  # fmt: skip

    def starts(numbers: NDArray[np.int64]) -> FloatArray:
        places = light.flat(numbers, seed=seed, box=box)
        return np.column_stack([places, np.full(len(places), plan.conversion_height)])

    found = expose(plan, total, starts, seed=seed, reference="even", progress=progress)
    return Flat(number, found.on, found.off, found.cpu_seconds, plan.key)


def periodic_covariances(images: NDArray[np.integer]) -> FloatArray:
    """Measure the covariances of periodic images at all lags, image by image.

    Parameters
    ----------
    images : ndarray, shape (n, ny, nx)
        Images that continue periodically [e-].

    Returns
    -------
    covariances : ndarray, shape (n, ny, nx)
        ``[j, i]`` at the lag (i, j) [e-^2], lags beyond half a side negative; about the mean
        of each image, whose variance is thus taken out: they sum to 0.
    """
    values = np.asarray(images, float)
    values = values - values.mean((1, 2), keepdims=True)
    spectrum = np.abs(np.fft.fft2(values)) ** 2
    return np.fft.ifft2(spectrum).real / values[0].size
