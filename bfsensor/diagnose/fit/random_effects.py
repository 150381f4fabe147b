"""Random effects of the diagnosis: variance parameters of effects, and modes in the channels.

The statistics are in :mod:`bfsensor.inference.random_effects`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.typing import FloatArray


def scored(predictor: Predictor) -> dict[int, tuple[str, ...]]:
    """Variance parameters by their index in ``predictor.space``, with the channels they enter."""
    return {
        int(row): effect.scatters
        for n, effect in enumerate(predictor.effects)
        if effect.scatters
        for row in predictor.space.rows("effect", n)
    }


def mode_slope(
    predictor: Predictor,
    channels: Sequence[Channel],
    point: FloatArray,
    n: int,
    words: tuple[str, ...],
) -> FloatArray:
    """Derivative of the whitened modes of some channels by a parameter, 0 in all others."""
    there = point.copy()
    there[n] += predictor.space.steps[n]
    parts = []
    for channel in channels:
        here = predictor.modes(channel, point)
        if channel.word in words and here.shape[1]:
            change = predictor.modes(channel, there) - here
            parts.append(channel.whiten(change) / predictor.space.steps[n])
        else:
            parts.append(np.zeros_like(here))
    out = np.zeros((sum(len(p) for p in parts), sum(p.shape[1] for p in parts)))
    row = column = 0
    for part in parts:
        rows, columns = part.shape
        out[row : row + rows, column : column + columns] = part
        row, column = row + rows, column + columns
    return out
