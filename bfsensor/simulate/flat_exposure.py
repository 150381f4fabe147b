"""Flats of the direct simulation: even light on the whole period, charge fed back.

A period holds few pixels; its covariances come from many flats.  The same electrons also go
through wells that all hold the mean charge, where charges of pixels are independent: what
moves between both images is the effect of the pixels' differences, and
:func:`measure_response` finds from it what one electron does to the pixels around it.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import DeviceError
from bfsensor.simulate import light
from bfsensor.simulate.build_up import build_up
from bfsensor.simulate.transport import Transport

if TYPE_CHECKING:
    from bfsensor.device import Device

_FLAT_STREAM = 0xF1A7


@dataclass(frozen=True)
class FlatPlan:
    """Flats to be built up, all alike but for their electrons.

    Parameters
    ----------
    device : Device
        The sensor at its operating point.
    level : float
        Electrons a pixel at the end [e-].
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
    """

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
        for name, value, low, high in (
            ("level", self.level, 1.0, 1e6),
            ("steps", self.steps, 1, 100_000),
            ("pixels", self.pixels, 3, 63),
            ("cells", self.cells, 8, 64),
            ("depth", self.height, light.LOWEST, self.device.silicon.thickness),
            ("seed", self.seed, 0, 2**63),
        ):
            if not low <= value <= high:
                raise DeviceError(
                    f"flats: {name} = {value:g} must be from {low:g} to {high:g}"
                )
        if self.pixels % 2 == 0:
            raise DeviceError(f"flats: pixels = {self.pixels} must be odd")

    @property
    def height(self) -> float:
        """Height of conversion [um]."""
        return self.device.silicon.thickness - 5.0 if self.depth is None else self.depth

    @property
    def key(self) -> str:
        """What tells the results of one plan from those of another."""
        names = ("level", "steps", "pixels", "cells", "depth", "transport", "seed")
        text = "\n".join(
            ["bfsensor flat 2", self.device.to_toml()]
            + [f"{name}={getattr(self, name)!r}" for name in names]
        )
        return hashlib.sha256(text.encode()).hexdigest()[:16]


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
    """

    number: int
    on: NDArray[np.int32] = field(repr=False)
    off: NDArray[np.int32] = field(repr=False)
    cpu_seconds: float


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
    """
    begin = time.process_time()
    rng = np.random.default_rng([plan.seed, number, _FLAT_STREAM])
    seed = int(rng.integers(2**63))
    total = int(rng.poisson(plan.level * plan.pixels**2))
    ends = np.round(np.linspace(0, total, plan.steps + 1)).astype(np.int64)
    pixel = plan.device.pixel
    half = plan.pixels / 2
    box = (-half * pixel.pitch_x, half * pixel.pitch_x, -half * pixel.pitch_y,
           half * pixel.pitch_y)  # fmt: skip

    def starts(numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        places = light.flat(numbers, seed=seed, box=box)
        return np.column_stack([places, np.full(len(places), plan.height)])

    on, off = build_up(
        plan.device, ends, starts, pixels=plan.pixels, cells=plan.cells,
        transport=plan.transport, seed=seed, reference="even", progress=progress,
    )  # fmt: skip
    return Flat(number, on, off, time.process_time() - begin)


def periodic_covariances(images: NDArray[np.integer]) -> NDArray[np.float64]:
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
