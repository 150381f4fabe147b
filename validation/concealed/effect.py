"""What an effect is: a class word, parameters, and what it does at each stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from validation.concealed.electrostatics import EdgeShifts
from validation.concealed.readout import Context
from validation.concealed.scene import Image, Scene


@dataclass(frozen=True)
class Range:
    """Where a parameter is drawn from.

    Attributes
    ----------
    low, high : float
        Ends; of the magnitude where ``signed``.
    law : str
        "log", "flat" or "whole" (whole numbers, both ends included).
    signed : bool
        Either sign, each half the time.
    amplitude : bool
        Zero switches the effect off; ``strength`` 0 to 1 goes from low to high.
    """

    low: float
    high: float
    law: str = "log"
    signed: bool = False
    amplitude: bool = False

    def draw(self, rng: np.random.Generator, strength: float | None = None) -> float:
        """Draw a value; ``strength`` in 0 to 1 fixes the place in the range of amplitudes."""
        place, sign = rng.random(), rng.random()
        if self.amplitude and strength is not None:
            place = strength
        if self.law == "whole":
            value = float(int(self.low + place * (self.high + 1 - self.low) * (1 - 1e-12)))
        elif self.law == "log":
            value = self.low * (self.high / self.low) ** place
        else:
            value = self.low + (self.high - self.low) * place
        return -value if self.signed and sign < 0.5 else value


@dataclass(frozen=True)
class Effect:
    """One thing the baseline leaves out; a subclass acts at the stages that it overrides.

    Attributes
    ----------
    parameters : mapping
        Named and defined as in the contract of `bfsensor diagnose`.
    variant : str
        Which of ``variants``.
    word : str
        Its class in the taxonomy.
    variants : mapping of str to mapping of str to Range
        Parameters of each variant.
    """

    parameters: Mapping[str, float]
    variant: str = ""
    word: ClassVar[str] = ""
    variants: ClassVar[Mapping[str, Mapping[str, Range]]] = {}

    def __post_init__(self) -> None:
        if self.variant not in self.variants:
            raise ValueError(
                f"{self.word}: variant = {self.variant!r}, one of {sorted(self.variants)}"
            )
        needed = set(self.variants[self.variant])
        if set(self.parameters) != needed:
            raise ValueError(
                f"{self.word}: parameters {sorted(self.parameters)}, needs {sorted(needed)}"
            )

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        strength: float | None = None,
        variant: str | None = None,
    ) -> Self:
        """Draw a variant and parameters."""
        names = sorted(cls.variants)
        chosen = names[rng.integers(len(names))] if variant is None else variant
        if chosen not in cls.variants:
            raise ValueError(f"{cls.word}: variant = {chosen!r}, one of {names}")
        ranges = cls.variants[chosen]
        return cls({name: r.draw(rng, strength) for name, r in ranges.items()}, chosen)

    def neutral(self) -> Self:
        """Return the same effect with every amplitude zero: it changes no bit."""
        ranges = self.variants[self.variant]
        values = {n: 0.0 if ranges[n].amplitude else v for n, v in self.parameters.items()}
        return type(self)(values, self.variant)

    def scaled(self, factor: float) -> Self:
        """Return the same effect with every amplitude multiplied."""
        ranges = self.variants[self.variant]
        values = {
            n: v * factor if ranges[n].amplitude else v for n, v in self.parameters.items()
        }
        return type(self)(values, self.variant)

    def truth(self) -> dict[str, Any]:
        """Return what truth.json says."""
        told: dict[str, Any] = {"class": self.word, "parameters": dict(self.parameters)}
        if self.variant:
            told["variant"] = self.variant
        return told

    def device(self, device: dict[str, float]) -> dict[str, float]:
        """Change the true device."""
        return device

    def shifts(self, shifts: EdgeShifts, context: Context) -> EdgeShifts:
        """Change the shifts per electron at the exposure's condition."""
        return shifts

    def laws(self, context: Context) -> dict[str, Any]:
        """Return further arguments of Response."""
        return {}

    def spot_light(self, context: Context) -> dict[str, float]:
        """Return additions to the spots: ``variance`` [pixel^2], ``halo``, ``halo_sigma``."""
        return {}

    def light(self, scene: Scene, context: Context) -> None:
        """Change the light before it meets pixels, in place."""

    def displaced(self, context: Context) -> tuple[Image, Image] | None:
        """Return standing displacements [pixel] of the edges between columns and between rows.

        Shapes (ny, nx + 1) and (ny + 1, nx): the rim's edges too.
        """
        return None

    def store(self, charge: Image, context: Context) -> Image:
        """Change the collected charge [e-]."""
        return charge

    def shift(self, frames: list[Image], context: Context) -> list[Image]:
        """Change frames in transfer [e-]."""
        return frames

    def amplifier(self, frames: list[Image], context: Context) -> list[Image]:
        """Change frames in the amplifier, before read noise [e-]."""
        return frames

    def noise(self, frames: list[Image], context: Context) -> list[Image]:
        """Add noise and offsets [e-]."""
        return frames

    def gain(self, context: Context) -> float:
        """Return a factor on the signal in ADU."""
        return 1.0

    def converter(
        self, levels: list[NDArray[np.float64]], context: Context
    ) -> list[NDArray[np.float64]]:
        """Change levels before rounding [ADU]."""
        return levels
