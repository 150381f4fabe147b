"""Brighter-fatter strength whose dependence on wavelength differs from the baseline's."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.typing import Edges, FloatArray

ZERO, STEP = 620.0, 330.0
"""Wavelength [nm] at which nothing changes, and interval [nm] over which shifts change by kappa.

Defined as the parameter's scale: kappa is the relative change from 620 to 950 nm."""


class BrighterFatterChromatic(Effect):
    """Shifts are (1 + kappa (wavelength - 620 nm) / 330 nm) times the baseline's.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``kappa``: 0.01 to 0.2 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> BrighterFatterChromatic({"kappa": 0.04}).name
    'bf_chromatic'
    """

    word = "bf_chromatic"
    stage = "collect"
    parameters = (Parameter("kappa", "", 0.01, 0.2, signed=True, amplitude=True),)
    touches = ("flat_cov", "spot")
    source = (
        "Light that converts deeper is pushed over a shorter path (Astier & Regnault 2023, A&A "
        "670, A118, model the bands of one camera); law and range assumed"
    )

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del layout
        factor = 1 + self["kappa"] * (shot.wavelength - ZERO) / STEP
        return (kx, ky) if factor == 1.0 else (factor * kx, factor * ky)
