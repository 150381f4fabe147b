"""Exposures of the concealed campaigns' virtual sensor as the diagnosis takes them, no files between."""

from __future__ import annotations

import json
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.model.baseline import Baseline, read_edges
from bfsensor.units import to_kelvin
from validation.concealed.arrays import iterate_exposures
from validation.concealed.card import baseline_edges, device_card
from validation.concealed.plan import SIZES, Geometry


@dataclass(frozen=True)
class Shot:
    """One exposure's conditions."""

    number: int
    kind: str
    exposure_time: float
    wavelength: float
    back_bias: float
    temperature: float
    lamp: float | None
    mjd: float
    pair: int | None = None
    withheld: bool = False


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One amplifier's frame in readout order [ADU]."""

    name: str
    pixels: NDArray[np.float32]
    geometry: Geometry
    number: int

    @property
    def image(self) -> NDArray[np.float32]:
        """Pixels of light."""
        g = self.geometry
        return self.pixels[: g.pixels, g.prescan : g.prescan + g.width]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Codes at the converter's end."""
        return self.image >= 65535

    @property
    def prescan(self) -> NDArray[np.float32]:
        """Before the first column."""
        return self.pixels[: self.geometry.pixels, : self.geometry.prescan]

    @property
    def serial_overscan(self) -> NDArray[np.float32]:
        """After the last column."""
        g = self.geometry
        return self.pixels[: g.pixels, g.prescan + g.width :]

    @property
    def parallel_overscan(self) -> NDArray[np.float32]:
        """After the last row."""
        g = self.geometry
        return self.pixels[g.pixels :, g.prescan : g.prescan + g.width]

    @property
    def flip_x(self) -> bool:
        """Odd amplifiers read from the high end of their strip."""
        return self.number % 2 == 1

    @property
    def flip_y(self) -> bool:
        """None does."""
        return False

    @property
    def origin(self) -> tuple[int, int]:
        """Of its strip on the sensor."""
        return self.number * self.geometry.width, 0


class VirtualSource:
    """A campaign taken in memory."""

    def __init__(
        self,
        *,
        seed: int,
        size: str = "S",
        effects: Sequence[Any] = (),
        amplifiers: int = 2,
        withheld: bool = False,
    ) -> None:
        pixels = SIZES[size].pixels if isinstance(size, str) else size.pixels
        self._geometry = Geometry(pixels, amplifiers)
        self._frames: dict[int, list[NDArray[np.uint16]]] = {}
        self.exposures: list[Shot] = []
        self.lamp_error = 2e-4
        self.shape = (self._geometry.pixels,) * 2
        for taken in iterate_exposures(
            size, seed=seed, effects=effects, amplifiers=amplifiers, withheld=withheld
        ):
            e = taken.exposure
            self.exposures.append(
                Shot(e.sequence, e.kind.lower(), e.seconds, e.wavelength, e.back_bias,
                     to_kelvin(e.temperature), taken.monitor or None, e.mjd, withheld=e.withheld)
            )  # fmt: skip
            self._frames[e.sequence] = taken.frames

    def part(self, *, withheld: bool) -> VirtualSource:
        """Give those that were kept back, with the biases that they need, or all others."""
        other = copy(self)
        other.exposures = [
            e
            for e in self.exposures
            if e.withheld == withheld or (withheld and e.kind == "bias")
        ]
        return other

    def read(self, exposure: Shot) -> list[RawFrame]:
        """Frames of an exposure."""
        return [
            RawFrame(f"amp {n}", data.astype(np.float32), self._geometry, n)
            for n, data in enumerate(self._frames[exposure.number])
        ]


@lru_cache(maxsize=1)
def virtual_baseline() -> Baseline:
    """What the simulation of the nominal virtual device predicts."""
    with TemporaryDirectory() as folder:
        edges, card = Path(folder) / "edges.json", Path(folder) / "card.json"
        edges.write_text(json.dumps(baseline_edges()))
        card.write_text(json.dumps(device_card("virtual", Geometry(256), 30.0)))
        return replace(
            read_edges(edges, card=card), name="edges of the nominal virtual device"
        )
