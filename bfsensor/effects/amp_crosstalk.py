"""Crosstalk: a part of each amplifier's signal is seen in the others."""

from __future__ import annotations

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.typing import FloatArray


class AmpCrosstalk(Effect):
    """``c`` of every other amplifier's signal is added, at the same pixel time.

    Flats are alike in all amplifiers: there it is a gain that light alone has, and is not told.
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
        # Of ADU in ADU: the victim's gain counts, and the aggressor's.
        gains = np.asarray(layout.gains if layout.gains else np.ones(len(layout.segments)))
        ratio = gains[axes["amp"].astype(int)] / gains[axes["other"].astype(int)]
        return np.where(axes["what"] == "crosstalk", self["c"] * ratio, 0.0)
