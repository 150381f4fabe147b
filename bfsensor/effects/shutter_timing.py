"""Shutter: exposures last longer than commanded, more on one side than on the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray


class ShutterTiming(Effect):
    """Light lasts ``dt`` (1 + shade x) longer than commanded, x from -1 to 1 across the columns.

    A level that is measured after the commanded time t holds the part dt / (t + dt) too much.
    """

    word = "shutter_timing"
    stage = "light"
    parameters = (
        Parameter("dt", "s", 5e-3, 5e-2, signed=True, amplitude=True),
        Parameter("shade", "", -0.5, 0.5, law="flat"),
    )
    # A shade is a gradient of the map of short exposures: the light's own shape hides it.
    touches = ("flat_mean", "spot")
    source = (
        "Opening and closing take time, more here than there: Stetson 1989, Highlights of Astronomy "
        "8, 635; Galadi-Enriquez, Jordi & Trullols 1995, IAU Symp. 167; 0.07 s in one camera: Lee 2016, "
        "J. Korean Astron. Soc. 49, 6; range assumed"
    )
    by_time = True

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"dt": sign * 0.02, "shade": shade}
            for sign in (1, -1) for shade in (-0.3, 0.0, 0.3)
        ]  # fmt: skip

    def light_map(self, shot: Shot, layout: Layout) -> FloatArray | None:
        if shot.kind not in ("flat", "spot") or not shot.seconds > 0:
            return None
        nx = layout.shape[1]
        x = 2 * (np.arange(nx) + 0.5) / nx - 1
        longer = self["dt"] * (1 + self["shade"] * x)
        return np.broadcast_to(1 + longer / shot.seconds, layout.shape)

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        nx = layout.shape[1]
        middle = np.array([2 * (s.x + 0.5 * s.columns) / nx - 1 for s in layout.segments])
        longer = self["dt"] * (1 + self["shade"] * middle[axes["amp"].astype(int)])
        return np.asarray(axes["level"] * longer / (axes["time"] + longer))

    def spot_flux(self, axes: Axes, layout: Layout) -> FloatArray:
        # Spots lie on all of the sensor: shade is nothing in their mean.
        return np.asarray(axes["flux"] * self["dt"] / (axes["time"] + self["dt"]))
