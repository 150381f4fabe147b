"""Gain non-linearity: the amplifier's response is a cubic polynomial of the signal."""

from __future__ import annotations

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.typing import FloatArray

SCALE = 1e5
"""Signal [e-] at which c2 and c3 are defined as relative changes."""


class GainNonlinearity(Effect):
    """Signal S becomes S (1 + c2 S/1e5 + c3 (S/1e5)^2), S in electrons.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``c2``: 0.001 to 0.02 in magnitude, either sign (0 changes nothing);
        ``c3``: 0.0003 to 0.005 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> GainNonlinearity({"c2": 0.004, "c3": 0.001}).name
    'gain_nonlinearity'
    """

    word = "gain_nonlinearity"
    stage = "amplifier"
    parameters = (
        Parameter("c2", "", 1e-3, 2e-2, signed=True, amplitude=True),
        Parameter("c3", "", 3e-4, 5e-3, signed=True, amplitude=True),
    )
    touches = ("flat_mean", "flat_cov", "spot")
    source = (
        "Polynomial response of video chains: Astier et al. 2019, A&A 629, A36, section 5 (0.6 % "
        "of an LSST test chain); range assumed"
    )

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        del shot
        return [self._bent(f) for f in frames]

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return self._bent(level)

    def _bent(self, signal: Image) -> Image:
        """Signal after the polynomial [e-]."""
        x = signal / SCALE
        return signal * (1 + self["c2"] * x + self["c3"] * x * x)
