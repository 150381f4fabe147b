"""Dependence of the shifts on the back bias that differs from the baseline's."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.typing import Edges, FloatArray

STEP = 20.0
"""Change of the back bias [V] over which shifts change by delta."""


class VoltageDependence(Effect):
    """Shifts grow by ``delta`` of the baseline's per 20 V less back bias than the reference."""

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
