"""Mask stitch: fields of the mask that do not meet, so that every n-th column boundary is off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges

PERIODS = range(16, 65)
FOUND = 3
"""Places seen in the maps that phases are taken from."""


class MaskStitch(Effect):
    """Each ``period``-th boundary between columns, counted from ``phase``, is off by ``amp`` pixels.

    The column before it is the wider for it, the one behind the narrower.
    """

    word = "mask_stitch"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 5e-4, 1e-2, signed=True, amplitude=True),
        Parameter("period", "pixel", PERIODS[0], PERIODS[-1], law="whole"),
        Parameter("phase", "pixel", 0, PERIODS[-1] - 1, law="whole"),
    )
    touches = ("flat_map",)
    of_pixels = True
    bends = True
    source = (
        "Pixel sizes that vary by 0.3 % in an LSST prototype: Baumer & Roodman 2015, JINST 10, "
        "C05024 (arXiv 1504.06088); that they repeat with the mask's field, and the range, are assumed"
    )
    standing = True

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """All periods, counted from the rim, and from boundaries that were seen."""
        counted = {(period, 0) for period in PERIODS}
        places = [
            (s["x"][0] + s["x"][1]) // 2
            for s in seen
            if s.get("what") == "column" and "x" in s and s["x"][1] - s["x"][0] <= 5
        ]
        for place in dict.fromkeys(int(p) for p in places[:FOUND]):
            counted |= {(period, place % period) for period in PERIODS}
        return [
            {"amp": 2e-3, "period": float(period), "phase": float(phase)}
            for period, phase in sorted(counted)
        ]

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        edge = np.arange(nx + 1)
        stitch = edge % int(self["period"]) == int(self["phase"]) % int(self["period"])
        # The rim itself is no boundary between columns.
        stitch[[0, -1]] = False
        return (
            np.broadcast_to(self["amp"] * stitch, (ny, nx + 1)),
            np.zeros((ny + 1, nx)),
        )
