"""Flats of the direct simulation: even light on the whole period, charge fed back.

A period holds few pixels; its covariances come from many flats.  The same electrons also go
through wells that all hold the mean charge, where charges of pixels are independent: what
moves between both images is the effect of the pixels' differences, and
:func:`measure_response` finds from it what one electron does to the pixels around it.
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
_FLAT_STREAM = 0xF1A7


@dataclass(frozen=True)
class FlatPlan(ExposurePlan):
    """Flats to be built up, all alike but for their electrons.

    Parameters
    ----------
    device : Device
        The sensor at its operating point.
    level : float
        Electrons a pixel at the end [e-].  At most the full well (:meth:`check_full_well`).
    steps : int
        Equal steps of charge.
    pixels, cells : int
        Period of the array [pixel], odd, and mesh cells a pixel.
    depth : float, optional
        Height of conversion above the gates [um]; by default 5 um below the back surface.
    transport : Transport
        How electrons move.
    seed : int
        Chooses all random numbers; flats differ by their number.

    Raises
    ------
    DeviceError
        A value that makes no sense, by name.
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
        """Refuse what cannot be."""
        self._check(level=(1.0, 1e6))


@dataclass(frozen=True)
class Flat:
    """A flat as it grew, with the effect and without.

    Attributes
    ----------
    number : int
        In its plan.
    on, off : ndarray, shape (steps, pixels, pixels)
        Electrons collected up to the end of each step, as periodic images [y, x] [e-]; ``off``
        with evenly filled wells.
    cpu_seconds : float
        What it took.
    key : str
        Of the plan; empty where not known.
    """

    number: int
    on: NDArray[np.int32] = field(repr=False)
    off: NDArray[np.int32] = field(repr=False)
    cpu_seconds: float
    key: str = ""

    def write(self, path: str | Path) -> None:
        """Write to FITS, whole or not at all."""
        cards = {
            "FLAT": (self.number, "number of the flat in its plan"),
            "PLANKEY": (self.key, "of the plan"),
            "CPU_S": (round(self.cpu_seconds, 2), "[s]"),
        }
        write_exposure(path, SCHEMA, cards, self.on, self.off)

    @classmethod
    def read(cls, path: str | Path) -> Flat:
        """Read what :meth:`write` wrote.

        Raises
        ------
        SimulationError
            Not such a file, or damaged.
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
        What to simulate.
    number : int
        Of the flat, from 0: chooses its electrons, and how many they are.
    progress : callable, optional
        Called with the number of the step that is done.

    Returns
    -------
    Flat
        The same bits for the same plan and number.  The electrons of a whole period are a
        Poisson number.

    Raises
    ------
    SimulationError
        The level is above the full well, see :meth:`FlatPlan.check_full_well`.
    ConvergenceError
        From the solver or the tracer.
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
    """Covariances of periodic images at all lags, one image after another.

    Parameters
    ----------
    images : ndarray, shape (n, ny, nx)
        Periodic [e-].

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
