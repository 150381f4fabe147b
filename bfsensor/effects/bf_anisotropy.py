"""Ratio of boundary shifts in x and y outside the uncertainty of the nominal device."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.typing import Edges, FloatArray


class BrighterFatterAnisotropy(Effect):
    """Shifts in x are (1 - eps / 2) times the baseline's, those in y (1 + eps / 2) times.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``eps``: 0.02 to 0.3 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> BrighterFatterAnisotropy({"eps": 0.08}).name
    'bf_anisotropy'
    """

    word = "bf_anisotropy"
    stage = "collect"
    parameters = (Parameter("eps", "", 0.02, 0.3, signed=True, amplitude=True),)
    touches = ("flat_cov", "spot")
    source = (
        "Boundaries between rows and columns are made by other barriers (electrostatic fits of "
        "Astier & Regnault 2023, A&A 670, A118); law and range assumed"
    )

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del shot, layout
        half = 0.5 * self["eps"]
        return (kx, ky) if half == 0.0 else ((1 - half) * kx, (1 + half) * ky)
