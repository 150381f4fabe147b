"""Tearing: a field distortion at a boundary between columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Edges, Effect, Layout, Parameter, Seen, Shot

CLOSED = 0.7
"""Mean part of the rows that the tear is open in: it closes at a row that moves (assumed)."""


class Tearing(Effect):
    """Edges beside one column boundary stand off by ``amp`` exp(-d / length) pixels.

    ``column``: place of the boundary as a part of the sensor's width.
    """

    word = "tearing"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 3e-3, 0.2, signed=True, amplitude=True),
        Parameter("length", "pixel", 1.0, 5.0),
        Parameter("column", "", 0.0, 1.0, law="flat"),
    )
    touches = ("flat_map",)
    source = "Juramy et al. 2020, Proc. SPIE 11454, 1145412 (e2v sensors, divisadero); range assumed"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        width = layout.shape[1]
        found = [s["x"] for s in seen if s["word"] == "flat_map" and "x" in s][:3]
        near = {
            b for low, high in found for b in range(int(low) - 4, int(high) + 5)
            if high - low < width / 8
        }  # fmt: skip
        return [
            {"amp": 0.02, "length": length, "column": boundary / width}
            for boundary in sorted(near or range(4, width, 8))
            for length in (1.5, 3.5)
            if 0 < boundary < width
        ]

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        edge = np.arange(nx + 1.0)
        fall = np.exp(-np.abs(edge - self["column"] * nx) / self["length"])
        torn = CLOSED * self["amp"] * fall
        return np.broadcast_to(torn, (ny, nx + 1)).copy(), np.zeros((ny + 1, nx))
