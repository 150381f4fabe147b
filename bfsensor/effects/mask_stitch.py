"""Mask stitch: misplaced fields of the mask displace every n-th boundary between columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges

PERIODS = range(16, 65)
"""Periods that are tried [pixel].

Chosen: with twice the top, 113 instead of 49 periods are tried, and the penalty for the number of
trials grows."""

FOUND = 3
"""Largest number of detected columns from which phases are taken.

Chosen: each adds 49 starts; twice as large, the search takes up to 1.75 times as long."""


class MaskStitch(Effect):
    """Every ``period``-th boundary between columns, from column ``phase``, is displaced by ``amp``.

    The column before such a boundary is wider by ``amp`` pixels, the one after it narrower.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.0005 to 0.01 in magnitude, either sign (0 changes
        nothing); ``period`` [pixel]: 16 to 64, whole; ``phase`` [pixel]: 0 to 63, whole.

    Examples
    --------
    >>> MaskStitch({"amp": 0.002, "period": 40, "phase": 31}).name
    'mask_stitch'
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
        """Begin with all periods, with phases of the rim and of boundaries detected in maps."""
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
        # The first and the last edge are no boundaries between columns.
        stitch[[0, -1]] = False
        return (
            np.broadcast_to(self["amp"] * stitch, (ny, nx + 1)),
            np.zeros((ny + 1, nx)),
        )
