"""What a campaign records, in the order of time: kinds, levels, conditions.

Sizes (side, flat pairs at each level of the first condition, pairs at each of two levels of other
conditions): T 128, 2, 1 (tests only); S 256, 4, 2; M 512, 8, 4; X 1024, 60, 12.

Ladders differ between campaigns: six to nine levels up to 0.9e5 to 1.2e5 e-, walked up and down
or shuffled, so that time is not flux; some campaigns repeat two levels at a third of the lamp's
current; other wavelengths, back biases and temperatures are there or not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

SECONDS_BETWEEN = 5.0
"""Readout and all else between two exposures [s]; as in the practice campaigns."""

FIRST_MJD = 60000.0
LAMP = 2000.0
"""Electrons per second and pixel of flats at full lamp current."""

SPOT_FLUX = 33000.0
"""Mean electrons per second in one spot; its brightest pixel holds about a tenth of them."""


@dataclass(frozen=True)
class Size:
    """Pixels and numbers of pairs and dithers."""

    pixels: int
    pairs: int
    condition_pairs: int
    dithers: int


SIZES = {
    "T": Size(128, 2, 1, 1),
    "S": Size(256, 4, 2, 3),
    "M": Size(512, 8, 4, 3),
    "X": Size(1024, 60, 12, 4),
}


@dataclass(frozen=True)
class Exposure:
    """One exposure; wavelength [nm], back bias [V], temperature [C], seconds as commanded.

    ``lamp`` is the lamp's current over its full one.
    """

    kind: str
    sequence: int
    mjd: float
    seconds: float
    wavelength: float = 620.0
    back_bias: float = -60.0
    temperature: float = -100.0
    lamp: float = 1.0

    @property
    def hours(self) -> float:
        """Time since the campaign began [h]."""
        return (self.mjd - FIRST_MJD) * 24.0

    @property
    def condition(self) -> tuple[float, float, float]:
        """Wavelength, back bias, temperature."""
        return self.wavelength, self.back_bias, self.temperature

    @property
    def lit(self) -> bool:
        """Whether light is on."""
        return self.kind in ("FLAT", "SPOT")


@dataclass(frozen=True)
class Plan:
    """Choices of one campaign; see the module."""

    size: str
    levels: tuple[float, ...]
    order: str = "zigzag"
    wavelengths: tuple[float, ...] = (480.0, 950.0)
    back_biases: tuple[float, ...] = (-40.0,)
    temperatures: tuple[float, ...] = (-80.0,)
    second_lamp: bool = False
    spots: bool = True
    seed: int = 0
    biases: int = 10
    darks: int = 4
    _cache: list = field(default_factory=list, repr=False, compare=False)

    def exposures(self) -> tuple[Exposure, ...]:
        """All exposures in the order of time.

        Examples
        --------
        >>> plan = Plan("S", (1.0, 5.0, 12.5, 20.0, 30.0, 40.0, 50.0, 60.0))
        >>> sum(e.kind == "FLAT" for e in plan.exposures())
        88
        """
        if not self._cache:
            self._cache.extend(_numbered(self._wanted()))
        return tuple(self._cache)

    def _wanted(self) -> Iterator[tuple[str, float, dict[str, Any]]]:
        size, rng = SIZES[self.size], np.random.default_rng([self.seed, 77])
        for _ in range(self.biases):
            yield "BIAS", 0.0, {}
        for _ in range(self.darks):
            yield "DARK", 60.0, {}
        for step in range(size.pairs):
            seconds = list(self.levels)
            if self.order == "shuffled":
                rng.shuffle(seconds)
            elif step % 2:
                seconds.reverse()
            for s in seconds:
                for _ in range(2):
                    yield "FLAT", s, {}
                if s == max(self.levels) and step < 4:
                    yield "DARK", 15.0, {}
        middle, bright = self.levels[len(self.levels) // 2], self.levels[-2]
        if self.second_lamp:
            for s in (middle, bright):
                for _ in range(2 * size.condition_pairs):
                    yield "FLAT", 3 * s, {"lamp": 1 / 3}
        others: list[dict[str, Any]] = [{"wavelength": w} for w in self.wavelengths]
        others += [{"back_bias": v} for v in self.back_biases]
        for condition in others:
            for s in (middle, bright):
                for _ in range(2 * size.condition_pairs):
                    yield "FLAT", s, condition
        if self.spots:
            ladder = (1.25, 3.75, 7.5, 11.25, 15.0, 20.0, 25.0, 30.0)
            for _ in range(size.dithers):
                for s in ladder:
                    yield "SPOT", s, {}
            others = [{"wavelength": w} for w in self.wavelengths[-1:]]
            others += [{"back_bias": v} for v in self.back_biases]
            others += [{"temperature": t} for t in self.temperatures]
            for s in (7.5, 25.0):
                for condition in others:
                    for _ in range(size.dithers):
                        yield "SPOT", s, condition
        for _ in range(4):
            yield "BIAS", 0.0, {}

    def conditions(self) -> list[tuple[float, float]]:
        """Wavelengths [nm] and back biases [V] that light is taken at, the first one first."""
        seen = [(620.0, -60.0)]
        for e in self.exposures():
            if e.lit and (e.wavelength, e.back_bias) not in seen:
                seen.append((e.wavelength, e.back_bias))
        return seen

    def truth(self) -> dict[str, Any]:
        """All choices, for the sealed truth."""
        return {k: getattr(self, k) for k in self.__dataclass_fields__ if k != "_cache"}


def _numbered(wanted: Iterator[tuple[str, float, dict[str, Any]]]) -> Iterator[Exposure]:
    elapsed = 0.0
    for n, (kind, seconds, condition) in enumerate(wanted):
        yield replace(
            Exposure(kind, n, FIRST_MJD + elapsed / 86400.0, seconds), **condition
        )
        elapsed += seconds + SECONDS_BETWEEN


def draw_plan(
    rng: np.random.Generator, size: str, spots: bool, needs: frozenset[str] = frozenset()
) -> Plan:
    """Draw the choices of a campaign in which what a law needs is recorded.

    ``needs`` may hold 'red', 'wavelengths', 'voltages', 'temperatures'.
    """
    count = int(rng.integers(6, 10)) if size != "T" else 4
    top = rng.uniform(45.0, 60.0)
    levels = np.round(np.concatenate([[1.0], np.linspace(5.0, top, count - 1)]), 2)
    waves: tuple[float, ...] = ((480.0, 950.0), (480.0, 870.0), (), (700.0, 1000.0))[
        rng.choice(4, p=[0.5, 0.15, 0.2, 0.15])
    ]
    if needs & {"red", "wavelengths"} and not (waves and max(waves) > 900):
        waves = (480.0, 950.0)
    biases: tuple[float, ...] = ((-40.0,), (), (-40.0, -50.0))[
        rng.choice(3, p=[0.6, 0.25, 0.15])
    ]
    if "voltages" in needs and not biases:
        biases = (-40.0,)
    temperatures: tuple[float, ...] = ((-80.0,), ())[rng.choice(2, p=[0.6, 0.4])]
    if "temperatures" in needs:
        temperatures = (-80.0,)
    return Plan(
        size,
        tuple(float(s) for s in levels),
        order=str(rng.choice(["zigzag", "shuffled"])),
        wavelengths=waves,
        back_biases=biases,
        temperatures=temperatures,
        second_lamp=bool(rng.random() < 0.25),
        spots=spots,
        seed=int(rng.integers(2**31)),
        biases=int(rng.integers(8, 16)) if size != "T" else 4,
        darks=int(rng.integers(3, 8)) if size != "T" else 2,
    )
