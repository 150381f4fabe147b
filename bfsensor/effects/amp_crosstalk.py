"""Crosstalk: a fraction of each amplifier's signal appears in all others."""

from __future__ import annotations

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.typing import FloatArray


class AmpCrosstalk(Effect):
    """The fraction ``c`` of every other amplifier's signal is added, at the same pixel time.

    In flats all amplifiers have about the same signal: crosstalk acts as a change of gain there
    and cannot be distinguished from it.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``c``: 1e-05 to 0.001 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> AmpCrosstalk({"c": 0.0001}).name
    'amp_crosstalk'
    """

    word = "amp_crosstalk"
    parameters = (Parameter("c", "", 1e-5, 1e-3, signed=True, amplitude=True),)
    touches = ("amp_cross",)
    source = (
        "Linear model with one coefficient for a pair of amplifiers, 6e-4 to 3e-3 of the KPNO "
        "Mosaic: Massey, Local Group Survey notes, I-2; lower end of LSST class assumed"
    )

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        if self["c"] == 0:
            return frames
        total = np.sum(frames, axis=0, dtype=frames[0].dtype)
        c = np.asarray(self["c"], total.dtype)
        return [f + c * (total - f) for f in frames]

    def amp_cross(self, axes: Axes, layout: Layout) -> FloatArray:
        # The channel is a ratio of ADU, victim over aggressor, while c is a ratio of electrons: the
        # gains [e-/ADU] enter the other way up.
        gains = np.asarray(layout.gains if layout.gains else np.ones(len(layout.segments)))
        ratio = gains[axes["amp"].astype(int)] / gains[axes["other"].astype(int)]
        return np.where(axes["what"] == "crosstalk", self["c"] * ratio, 0.0)
