"""Free parameters of effects: start values, derivative steps, and limits of a fit's steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Parameter
from bfsensor.inference.parameters import FreeParameter, ParameterSpace
from bfsensor.typing import FloatArray


def parameters_of(effects: Sequence[Effect]) -> ParameterSpace:
    """Make the free parameters of several effects, which belong to the effect's place among them.

    Parameters
    ----------
    effects : sequence of Effect
        Effects with the values at which the fit starts.

    Returns
    -------
    space : ParameterSpace
        Of kind 'effect'.
    """
    return ParameterSpace(
        tuple(
            FreeParameter(
                f"effect {n} {e.name} {p.name}", "effect", n, e[p.name], _step(e, p), False,
                *p.widest,
            )
            for n, e in enumerate(effects)
            for p in fitted(e)
        )
    )  # fmt: skip


def effects_at(effects: Sequence[Effect], values: FloatArray) -> tuple[Effect, ...]:
    """Make the effects with given free parameters, shape (n,)."""
    left = iter(values)
    return tuple(
        e.with_values(**{p.name: float(next(left)) for p in fitted(e)}) for e in effects
    )


def fitted(effect: Effect) -> list[Parameter]:
    """Parameters that are fitted; whole numbers keep the values of the search."""
    return [p for p in effect.parameters if p.law != "whole"]


def reach_of(p: Parameter, value: float) -> tuple[float, float]:
    """Smallest and largest step of a fit from a parameter's value.

    Amplitudes stay within their widened range.  Parameters of a shape also change by no more
    than to half or twice their value, or a quarter of their range, in one step, as a
    derivative predicts larger changes badly.
    """
    away, far = value - p.neutral, 0.25 * (p.high - p.low)
    range_ = np.array(p.widest) - value
    step = np.array([-0.5, 1.0]) * away if p.law == "log" else far * np.array([-1, 1])
    held = p.amplitude or (p.law == "log" and p.signed)
    low, high = range_ if held else np.clip(step, *range_)
    # A value outside its range may only move towards it.
    return min(float(low), 0.0), max(float(high), 0.0)


def _step(effect: Effect, p: Parameter) -> float:
    """Step of a derivative: small against the value, or against the least plausible value."""
    if p.step:
        return p.step
    scale = abs(effect[p.name] - p.neutral)
    return 0.02 * max(scale, p.low) if p.law == "log" else 0.01 * (p.high - p.low)
