"""Gain drift: the gain changes linearly with time."""

from __future__ import annotations

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.typing import FloatArray


class GainDrift(Effect):
    """The signal in ADU grows by the fraction ``slope`` per hour since the first exposure.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``slope`` [1/h]: 0.0005 to 0.02 in magnitude, either sign (0 changes
        nothing).

    Examples
    --------
    >>> GainDrift({"slope": 0.003}).name
    'gain_drift'
    """

    word = "gain_drift"
    parameters = (Parameter("slope", "1/h", 5e-4, 2e-2, signed=True, amplitude=True),)
    touches = ("flat_mean", "flat_cov", "spot")
    source = (
        "Gain follows the electronics' temperature by some 5e-4/K (assumed): drifts of up to tens "
        "of K an hour while a chain warms up"
    )

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        if self["slope"] == 0:
            return frames
        return [f * np.asarray(1 + self["slope"] * shot.hours, f.dtype) for f in frames]

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        if "hours" not in axes:
            return level
        return level * (1 + self["slope"] * np.nan_to_num(axes["hours"]))
