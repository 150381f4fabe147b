"""Shutter timing: exposures last longer than commanded, by an amount that varies in x."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray


class ShutterTiming(Effect):
    """Exposures last ``dt`` (1 + shade x) longer than commanded, x from -1 to 1 across the columns.

    Of the level of an exposure of the commanded time t, the fraction dt / (t + dt) is additional.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``dt`` [s]: 0.005 to 0.05 in magnitude, either sign (0 changes nothing);
        ``shade``: -0.5 to 0.5.

    Examples
    --------
    >>> ShutterTiming({"dt": 0.02, "shade": 0.0}).name
    'shutter_timing'
    """

    word = "shutter_timing"
    stage = "light"
    parameters = (
        Parameter("dt", "s", 5e-3, 5e-2, signed=True, amplitude=True),
        Parameter("shade", "", -0.5, 0.5, law="flat"),
    )
    # A shade makes a gradient in maps of short exposures, which the unknown illumination hides.
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
        # Spots lie on all of the sensor: the shade cancels in their mean.
        return np.asarray(axes["flux"] * self["dt"] / (axes["time"] + self["dt"]))
