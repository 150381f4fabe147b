"""Ratio of boundary shifts in x and y outside the uncertainty of the nominal device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges, FloatArray


class BrighterFatterAnisotropy(Effect):
    r"""Shifts in x are (1 - e / 2) times the baseline's, those in y (1 + e / 2) times.

    .. math:: e = \varepsilon\, e^{-n (r - 1/2)}

    r is the distance of an edge's middle from the charge [pixel]; ``near`` n is 0 where all edges change
    alike, above 0 where barriers of unlike height are felt near the charge only.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``eps``: 0.02 to 0.3 in magnitude, either sign (0 changes nothing); ``near``
        [1/pixel]: 0 to 2.

    Examples
    --------
    >>> BrighterFatterAnisotropy({"eps": 0.08}).law_name
    'uniform'
    """

    word = "bf_anisotropy"
    stage = "collect"
    parameters = (
        Parameter("eps", "", 0.02, 0.3, signed=True, amplitude=True),
        Parameter("near", "1/pixel", 0.0, 2.0, law="flat", plain=0.0, ends=(0.0, np.inf)),
    )
    touches = ("flat_cov", "spot")
    source = (
        "Coefficients of the two axes are independent: Antilogus et al. 2014, JINST 9, C03048; "
        "boundaries between rows and columns are made by other barriers (electrostatic fits of "
        "Astier & Regnault 2023, A&A 670, A118), which near edges feel most; exponential and "
        "range assumed"
    )

    @property
    def law_name(self) -> str:
        """'near' if the second pixel's edges feel less than half of what the first pixel's do."""
        return "near" if self["near"] > np.log(2.0) else "uniform"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"eps": 0.08, "near": near} for near in (0.0, 1.0)]

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del shot, layout
        if self["eps"] == 0.0:
            return kx, ky
        lag = np.arange(len(kx)) - len(kx) // 2
        # Right edges lie half a pixel farther in x, upper ones in y.
        away = np.hypot(lag + 0.5, lag[:, None])
        half = 0.5 * self["eps"] * np.exp(-self["near"] * (away - 0.5))
        return (1 - half) * kx, (1 + half.T) * ky
