"""Parameters of effects that a fit moves: from where, by what steps, how far."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.effect import Effect, Parameter
from bfsensor.typing import FloatArray


class FittedEffects:
    """Effects whose parameters a fit moves, one after another.

    Parameters
    ----------
    effects : sequence of Effect
        With the values at which the fit begins.

    Attributes
    ----------
    effects : tuple of Effect
        As given.
    names : tuple of str
        Of the parameters.
    start, steps : ndarray, shape (n,)
        Where the fit begins, and steps of derivatives.
    shapes : ndarray of bool, shape (n,)
        Which are of the shape of an effect, not its amplitude.
    """

    def __init__(self, effects: Sequence[Effect] = ()) -> None:
        self.effects = tuple(effects)
        self._each = [(n, e, p) for n, e in enumerate(self.effects) for p in fitted(e)]
        self.names = tuple(f"effect {n} {e.name} {p.name}" for n, e, p in self._each)
        self.start = np.array([e[p.name] for _, e, p in self._each], float)
        self.steps = np.array([_step(e, p) for _, e, p in self._each], float)
        self.shapes = np.array([not p.amplitude for _, _, p in self._each], bool)

    def __len__(self) -> int:
        return len(self._each)

    def at(self, values: FloatArray) -> tuple[Effect, ...]:
        """Effects with their parameters as given, shape (n,)."""
        left = iter(values)
        return tuple(
            e.with_values(**{p.name: float(next(left)) for p in fitted(e)})
            for e in self.effects
        )

    def touch(self, word: str) -> NDArray[np.bool_]:
        """Which parameters a channel can depend on."""
        return np.array([word in e.touches for _, e, _ in self._each], bool)

    def reach(self, values: FloatArray) -> FloatArray:
        """Smallest and largest steps of a fit from values, shape (2, n)."""
        ends = [
            reach_of(p, float(v)) for (_, _, p), v in zip(self._each, values, strict=True)
        ]
        return np.array(ends, float).reshape(-1, 2).T


def fitted(effect: Effect) -> list[Parameter]:
    """Parameters that a fit may move: whole numbers stay where the search put them."""
    return [p for p in effect.parameters if p.law != "whole"]


def widened(p: Parameter) -> tuple[float, float]:
    """Range of a parameter in fits: ten times beyond the plausible one, or half of its width."""
    if p.law == "log":
        low = -10 * p.high if p.signed else (0.0 if p.amplitude else 0.3 * p.low)
        return p.neutral + low, p.neutral + (10 * p.high if p.amplitude else 3 * p.high)
    reach = 0.5 * (p.high - p.low)
    return p.low - reach, p.high + reach


def reach_of(p: Parameter, value: float) -> tuple[float, float]:
    """Smallest and largest step of a fit from a parameter's value.

    Effects stay in their ranges, widened; parameters of a shape go no farther than a
    derivative can tell: to half or twice, or a quarter of a range.
    """
    away, far = value - p.neutral, 0.25 * (p.high - p.low)
    range_ = np.array(widened(p)) - value
    step = np.array([-0.5, 1.0]) * away if p.law == "log" else far * np.array([-1, 1])
    held = p.amplitude or (p.law == "log" and p.signed)
    low, high = range_ if held else np.clip(step, *range_)
    # From beyond its range no farther.
    return min(float(low), 0.0), max(float(high), 0.0)


def _step(effect: Effect, p: Parameter) -> float:
    """Of derivatives: small against the value, or the least plausible one."""
    if p.step:
        return p.step
    scale = abs(effect[p.name] - p.neutral)
    return 0.02 * max(scale, p.low) if p.law == "log" else 0.01 * (p.high - p.low)
