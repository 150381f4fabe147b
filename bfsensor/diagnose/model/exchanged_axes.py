"""Named hypotheses outside the library: they stand among the candidates like its effects."""

from __future__ import annotations

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.typing import Edges, FloatArray


class AxesExchanged(Effect):
    """The baseline's x and y are exchanged: its shifts go ``amp`` of the way to their transposes.

    1 where a table, a file of covariances or a list of lags was read with its axes the other way
    round.  Half an exchange has no such meaning: about 1 the size is free, as a test.
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
        """Shifts of right and upper edges per electron."""
        amp = self["amp"]
        return kx + amp * (ky.T - kx), ky + amp * (kx.T - ky)


NAMED: tuple[type[Effect], ...] = (AxesExchanged,)
"""All of them."""


def says_exchanged(value: float, error: float) -> str:
    """In words, with how far the size is from a whole exchange."""
    off = abs(value - 1.0) / error if error > 0 else np.inf
    fits = (
        "as a whole exchange has it" if off < 3 else f"{off:.1f} standard deviations from 1"
    )
    return (
        f"The axes are exchanged: the shifts in x are those of the baseline in y and the other "
        f"way round ({value:.2f} +- {error:.2f} of the way, {fits})"
    )
