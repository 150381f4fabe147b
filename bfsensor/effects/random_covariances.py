"""Scatter of the covariances of flats that a random effect adds, as modes of the channel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Layout
from bfsensor.typing import FloatArray

SIDE = 32
"""Side of the periodic array on which effects add their covariances [pixel].

Chosen: measured lags, 4 by default, must stay below half of it; twice as large gives the same values
in four times the memory."""


def scatter_of_pairs(
    effect: Effect,
    axes: Axes,
    layout: Layout,
    relative: Callable[[int, float, float], float],
) -> FloatArray | None:
    """Give the modes of measured covariances whose lags all scatter together.

    There is one mode for each amplifier and condition: a stronger realisation of the random effect
    raises the covariances at all lags in proportion.

    Parameters
    ----------
    effect : Effect
        Effect with random covariances.
    axes : mapping
        Axes of the channel, arrays of shape (n,): 'amp', 'level' [e-], 'time' [s], 'pairs', lags
        'i' and 'j' [pixel], conditions.
    layout : Layout
        Sensor and campaign.
    relative : callable
        Function of amplifier, level [e-] and time [s] that gives the relative scatter of the
        covariance added by the effect in one pair.

    Returns
    -------
    modes : ndarray, shape (n, groups), or None
        One standard deviation of each mode [e-^2]; None if the channel has no numbers of pairs.
    """
    if "pairs" not in axes:
        return None
    keys = np.column_stack([
        np.nan_to_num(np.asarray(axes[n], float))
        for n in ("amp", "time", "wavelength", "back_bias", "temperature")
    ])  # fmt: skip
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    groups = {k: np.asarray(v)[first] for k, v in axes.items()}
    added = effect.covariances(np.zeros((len(first), SIDE, SIDE)), groups, layout)
    which = which.ravel()
    i, j = (np.asarray(axes[n]).astype(int) for n in "ij")
    mean = 0.5 * (added[which, j, i] + added[which, -j, i])
    strength = np.array([
        relative(int(amp), float(level), float(time)) / np.sqrt(max(pairs, 1))
        for amp, level, time, pairs in zip(
            *(groups[n] for n in ("amp", "level", "time", "pairs")), strict=True
        )
    ])  # fmt: skip
    out = np.zeros((len(mean), len(first)))
    out[np.arange(len(mean)), which] = mean * strength[which]
    return out
