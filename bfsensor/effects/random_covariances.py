"""What chance leaves of the covariances that a random effect adds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Layout
from bfsensor.typing import FloatArray

SIDE = 32
"""Of the periodic array that covariances are asked for on."""


def scatter_of_pairs(
    effect: Effect,
    axes: Axes,
    layout: Layout,
    relative: Callable[[int, float, float], float],
) -> FloatArray | None:
    """Modes of measured covariances: all lags of one amplifier's flats scatter together.

    Parameters
    ----------
    effect : Effect
        Adds to covariances.
    axes : mapping
        Of the channel, shape (n,): 'amp', 'level' [e-], 'time', 'pairs', 'i', 'j', conditions.
    layout : Layout
        Sensor and campaign.
    relative : callable
        Scatter of what one pair adds, over its mean, by amplifier, level [e-] and time [s].

    Returns
    -------
    modes : ndarray, shape (n, groups), or None
        [e-^2]; None of covariances without pairs.
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
