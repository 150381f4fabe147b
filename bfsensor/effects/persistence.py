"""Persistence: charge of an exposure is trapped and appears in the exposures that follow it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.dark_pixels import mean_bias, struck_pixels
from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

MEMORY = 40
"""Number of exposures for which pixels remember charge that is released by a power of the age.

Chosen: the power 1 leaves 2.5 % of what the next exposure shows to the fortieth; twice as large, the
memory of pixels doubles."""


class Persistence(Effect):
    """The fraction ``frac`` exp(-k / tau) of a charge appears in the k-th exposure after it.

    Exposures are counted by their numbers.  Missing numbers count as exposures, but the charge that
    they left is not known: it is a random effect.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``frac``: 1e-05 to 0.001 (0 changes nothing); ``tau`` [exposure]: 0.7 to
        5.

    Examples
    --------
    >>> Persistence({"frac": 0.0001, "tau": 2.0}).name
    'persistence'
    """

    word = "persistence"
    stage = "store"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("frac", "", 1e-5, 1e-3, amplitude=True),
        Parameter("tau", "exposure", 0.7, 5.0),
    )
    touches = ("dark_map", "flat_mean", "bias_level", "spot")
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    source = (
        "Polin, Snyder, Lage & Tyson 2025, JINST 20, P07031 (arXiv 2502.05418: residual charge in "
        "LSST's e2v sensors); an exponential in exposures and its range are assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"frac": 1e-4, "tau": tau} for tau in (0.8, 1.3, 2.1, 3.5)]

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> Image:
        left = np.zeros_like(charge)
        trapped = self._trapped(charge)
        for n, (part, tau) in enumerate(self._species()):
            held = memory.get(f"{self.word} {n}", np.zeros_like(charge))
            left += held
            # Only the light of an exposure is trapped, not the charge that traps release into it.
            kept = (held + self["frac"] * part * trapped) * np.exp(-1 / tau)
            memory[f"{self.word} {n}"] = kept.astype(charge.dtype)
        return charge + rng.poisson(left).astype(charge.dtype)

    def _species(self) -> list[tuple[float, float]]:
        """Parts of the charge that are released exponentially, and their constants [exposure]."""
        return [(1.0, self["tau"])]

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        return self._left_at(axes["exposure"], layout) - self._in_bias(layout)

    def bias_level(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.where(
            axes["what"] == "level", self._left_at(axes["exposure"], layout), 0.0
        )

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        noise, more = layout.noise, mean_bias(layout)
        # Biases hold charge of earlier exposures too, and their mean is subtracted from darks.
        left = self._left_at(axes["exposure"], layout) - self._in_bias(layout)
        out = np.zeros(len(left))
        for row in np.nonzero(np.isin(axes["what"], ("level", "struck")))[0]:
            amp = int(axes["amp"][row])
            part, others = struck_pixels(left[row], left[row], noise[amp], more)
            segment = layout.segments[amp]
            struck = axes["what"][row] == "struck"
            out[row] = part * segment.rows * segment.columns if struck else others
        return out

    def spot_ghosts(
        self, shown: FloatArray, lit: FloatArray, layout: Layout
    ) -> FloatArray | None:
        parts = self._after(np.subtract.outer(shown, lit))
        biases = np.array(layout.biases, float)
        if len(biases):
            # Biases hold ghosts too, and their mean is subtracted from all exposures.
            parts = parts - self._after(np.subtract.outer(biases, lit)).mean(0)
        return np.asarray(parts)

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        if word not in ("flat_mean", "dark_map") or not layout.shots:
            return None
        # The light of missing exposures is not known: it has the rms level of the others.
        numbers = np.array([s.number for s in layout.shots])
        lit = np.array([s.level for s in layout.shots if s.level > 0])
        gaps = [g for g in zip(numbers[:-1] + 1, numbers[1:], strict=True) if g[0] < g[1]]
        if not gaps or not len(lit):
            return None
        usual = float(np.sqrt((self._trapped(lit) ** 2).mean()))
        rows = np.ones(len(axes["exposure"]), bool)
        if word == "dark_map":
            rows = axes["what"] == "level"
        return np.stack([
            rows * usual
            * self._after(np.subtract.outer(axes["exposure"], np.arange(*gap)).astype(float)).sum(1)
            for gap in gaps
        ], axis=1)  # fmt: skip

    def _trapped(self, charge: NDArray) -> FloatArray:
        """Part of a pixel's charge that counts [e-]."""
        return np.asarray(charge)

    def _after(self, later: FloatArray) -> FloatArray:
        """Fraction of a charge that appears ``later`` exposures later; 0 if not later."""
        shown = self["frac"] * np.exp(-np.maximum(later, 0.0) / self["tau"])
        return np.where(later > 0, shown, 0.0)

    def _in_bias(self, layout: Layout) -> float:
        """Charge of earlier exposures in the mean bias [e-]."""
        if not layout.biases:
            return 0.0
        return float(self._left_at(np.array(layout.biases, float), layout).mean())

    def _left_at(self, number: FloatArray, layout: Layout) -> FloatArray:
        """Charge that earlier exposures left in those with these numbers [e-]."""
        lit = [s for s in layout.shots if s.level > 0]
        later = np.subtract.outer(
            np.asarray(number, float), np.array([s.number for s in lit], float)
        )
        return np.asarray(
            self._after(later) @ self._trapped(np.array([s.level for s in lit]))
        )


class PowerPersistence(Persistence):
    """The fraction ``frac`` k^-exponent exp(-k / tau) of a charge appears in the k-th exposure after it.

    Traps of all release times up to ``tau`` release as a power of the time, and faster after tau.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``frac``: 1e-05 to 0.001 (0 changes nothing); ``exponent``: 0 to 3;
        ``tau`` [exposure]: 3 to 300.

    Examples
    --------
    >>> PowerPersistence({"frac": 0.0001, "exponent": 1.0, "tau": 50.0}).name
    'persistence:power'
    """

    variant = "power"
    parameters = (
        Parameter("frac", "", 1e-5, 1e-3, amplitude=True),
        Parameter("exponent", "", 0.0, 3.0, law="flat"),
        Parameter("tau", "exposure", 3.0, 300.0),
    )
    source = (
        "A range of release times gives a power of time: Smith et al. 2008, Proc. SPIE 7021, 70210J, "
        "theory of image persistence; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"frac": 1e-4, "exponent": v, "tau": tau}
            for v in (0.5, 1.5)
            for tau in (10.0, 60.0)
        ]

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> Image:
        # No sum of a few exponentials: the charge of each exposure is remembered.
        held = memory.get(self.word, np.zeros((0, *charge.shape), charge.dtype))
        share = self._after(np.arange(1.0, len(held) + 1))
        left = (
            np.tensordot(share, held, 1).astype(charge.dtype) if len(held) else 0 * charge
        )
        memory[self.word] = np.concatenate([charge[None], held[: MEMORY - 1]])
        return charge + rng.poisson(left).astype(charge.dtype)

    def _after(self, later: FloatArray) -> FloatArray:
        k = np.maximum(later, 1.0)
        shown = self["frac"] * k ** -self["exponent"] * np.exp(-k / self["tau"])
        return np.where(later > 0, shown, 0.0)


class TwoTimesPersistence(Persistence):
    """Charge above ``threshold`` decays with two constants, the part ``slow`` with ``slow_tau``.

    The fraction frac ((1 - slow) exp(-k / tau) + slow exp(-k / slow_tau)) of it appears in the k-th
    exposure after it.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``frac``: 1e-05 to 0.001 (0 changes nothing); ``tau`` [exposure]: 0.3 to
        5; ``slow``: 0.02 to 0.98; ``slow_tau`` [exposure]: 2 to 30; ``threshold`` [e-]: 300 to 100000.

    Examples
    --------
    >>> values = {"frac": 1e-4, "tau": 1.0, "slow": 0.2, "slow_tau": 8.0, "threshold": 3e4}
    >>> TwoTimesPersistence(values).name
    'persistence:two_times'
    """

    variant = "two_times"
    parameters = (
        Parameter("frac", "", 1e-5, 1e-3, amplitude=True),
        Parameter("tau", "exposure", 0.3, 5.0),
        Parameter("slow", "", 0.02, 0.98, law="flat", ends=(0.0, 1.0)),
        Parameter("slow_tau", "exposure", 2.0, 30.0),
        Parameter("threshold", "e-", 300.0, 1e5),
    )
    source = (
        "Residual images of LSST's e2v sensors, of two causes and above a level: Polin, Snyder, Lage "
        "& Tyson 2025, JINST 20, P07031; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"frac": 1e-4, "tau": 1.0, "slow": 0.3, "slow_tau": 8.0, "threshold": level}
            for level in (3e3, 4e4)
        ]

    def _trapped(self, charge: NDArray) -> FloatArray:
        return np.maximum(charge - self["threshold"], 0.0)

    def _species(self) -> list[tuple[float, float]]:
        slow = self["slow"]
        return [(1 - slow, self["tau"]), (slow, self["slow_tau"])]

    def _after(self, later: FloatArray) -> FloatArray:
        k = np.maximum(later, 0.0)
        shown = sum(part * np.exp(-k / tau) for part, tau in self._species())
        return np.where(later > 0, self["frac"] * shown, 0.0)
