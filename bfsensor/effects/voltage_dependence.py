"""Boundary shifts whose dependence on the back bias differs from the baseline's."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.typing import Edges, FloatArray

STEP = 20.0
"""Interval of the back bias [V] for which delta is defined as the relative change of shifts."""


class VoltageDependence(Effect):
    """Shifts grow by ``delta`` of the baseline's for each 20 V of back bias above the reference.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``delta``: 0.02 to 0.3 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> VoltageDependence({"delta": 0.08}).name
    'voltage_dependence'
    """

    word = "voltage_dependence"
    stage = "collect"
    parameters = (Parameter("delta", "", 0.02, 0.3, signed=True, amplitude=True),)
    touches = ("flat_cov", "spot")
    source = (
        "Shifts go with the time that a drifting electron is pushed for, one over the field: "
        "Lage, Bradshaw & Tyson 2017, JINST 12, C03091; range assumed"
    )

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        factor = 1 + self["delta"] * (shot.back_bias - layout.reference[1]) / STEP
        return (kx, ky) if factor == 1.0 else (factor * kx, factor * ky)
