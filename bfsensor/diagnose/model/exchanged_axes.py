"""Hypotheses outside the library that are tested like effects: x and y of the baseline exchanged."""

from __future__ import annotations

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.effects.family import EffectFamily
from bfsensor.typing import Edges, FloatArray


class AxesExchanged(Effect):
    """The baseline's x and y are exchanged: its shifts move by ``amp`` towards their transposes.

    ``amp`` is 1 where a table, a file of covariances or a list of lags was read with its axes
    exchanged.  Other values have no such meaning; it is free about 1 as a test of the hypothesis.
    """

    word = "outside_library"
    variant = "axes_exchanged"
    stage = "collect"
    parameters = (Parameter("amp", "", 0.9, 1.1, law="flat", amplitude=True),)
    touches = ("flat_cov", "spot")
    source = (
        "Tables differ in which lag comes first: a_ij of Astier et al. 2019, A&A 629, A36, has i "
        "along the serial register; arrays of images have it last"
    )

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        """Shifts of right and upper edges [pixel/e-], moved towards their transposes."""
        amp = self["amp"]
        return kx + amp * (ky.T - kx), ky + amp * (kx.T - ky)


NAMED: tuple[EffectFamily, ...] = (AxesExchanged,)
"""All hypotheses outside the library."""


def says_exchanged(value: float, error: float) -> str:
    """Sentence that states the exchange and its size, with the distance from a complete one."""
    off = abs(value - 1.0) / error if error > 0 else np.inf
    fits = (
        "1 for a complete exchange"
        if off < 3
        else f"{off:.1f} standard deviations from 1, which is a complete exchange"
    )
    return (
        "The axes are exchanged: the boundary shifts in x are those of the baseline in y, and those "
        f"in y are the baseline's in x (size {value:.2f} +- {error:.2f}, {fits})"
    )
