"""Mask stitch: misplaced fields of the mask displace every n-th boundary of columns or of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges

PERIODS = range(8, 65)
"""Periods that are tried [pixel].

Chosen: below 8 several displaced boundaries lie in the reach of one another's diffusion; with twice the
top, 121 instead of 57 periods are tried, and the penalty for the number of trials grows."""

FOUND = 3
"""Largest number of detected columns from which phases are taken.

Chosen: each adds 57 starts; twice as large, the search takes up to 1.75 times as long."""


class MaskStitch(Effect):
    """Every ``period``-th boundary of columns or rows, from number ``phase``, is displaced by ``amp``.

    The column or row before such a boundary is wider by ``amp`` pixels, the one after it narrower.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.0005 to 0.01 in magnitude, either sign (0 changes
        nothing); ``period`` [pixel]: 8 to 64, whole; ``phase`` [pixel]: 0 to 63, whole;
        ``along``: 0 to 1, whole: boundaries between columns, or between rows.

    Examples
    --------
    >>> MaskStitch({"amp": 0.002, "period": 40, "phase": 31, "along": 0}).name
    'mask_stitch'
    """

    word = "mask_stitch"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 5e-4, 1e-2, signed=True, amplitude=True),
        Parameter("period", "pixel", PERIODS[0], PERIODS[-1], law="whole"),
        Parameter("phase", "pixel", 0, PERIODS[-1] - 1, law="whole"),
        Parameter("along", "", 0, 1, law="whole", plain=0.0),
    )
    touches = ("flat_map",)
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    response = "quadratic"
    source = (
        "Pixel sizes that vary by 0.3 % in an LSST prototype: Baumer & Roodman 2015, JINST 10, "
        "C05024 (arXiv 1504.06088); that they repeat with the mask's field, and the range, are assumed"
    )
    maps_vary = "nothing"
    law_name = "step"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin with all periods, with phases of the rim and of boundaries detected in maps."""
        counted = {(period, 0, along) for period in PERIODS for along in (0, 1)}
        for along, (what, axis) in enumerate((("column", "x"), ("row", "y"))):
            places = [
                (s[axis][0] + s[axis][1]) // 2
                for s in seen
                if s.get("what") == what and axis in s and s[axis][1] - s[axis][0] <= 5
            ]
            for place in dict.fromkeys(int(p) for p in places[:FOUND]):
                counted |= {(period, place % period, along) for period in PERIODS}
        return [
            {
                "amp": 2e-3,
                "period": float(period),
                "phase": float(phase),
                "along": float(along),
            }
            for period, phase, along in sorted(counted)
        ]

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        n = ny if self["along"] else nx
        edge = np.arange(n + 1)
        stitch = edge % int(self["period"]) == int(self["phase"]) % int(self["period"])
        # The first and the last edge are no boundaries between pixels.
        stitch[[0, -1]] = False
        moved = self["amp"] * stitch
        if self["along"]:
            return np.zeros((ny, nx + 1)), np.broadcast_to(moved[:, None], (ny + 1, nx))
        return np.broadcast_to(moved, (ny, nx + 1)), np.zeros((ny + 1, nx))


class WavyMask(Effect):
    r"""Pixel edges displaced by a sine of the column or of the row, as an error that runs on in a field.

    .. math:: u(x) = A \sin 2 \pi \left( \frac{x}{P} + \varphi \right)

    ``amp`` A is the displacement [pixel], ``period`` P [pixel], ``phase`` :math:`\varphi` in cycles;
    ``along`` is 0 for edges between columns, x being the edge's number, and 1 for those between rows.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.0005 to 0.01 (0 changes nothing); ``period`` [pixel]: 8
        to 64; ``phase`` [cycle]: -0.5 to 0.5; ``along``: 0 to 1, whole.

    Examples
    --------
    >>> WavyMask({"amp": 0.002, "period": 40.0, "phase": 0.25, "along": 0}).name
    'mask_stitch:wave'
    """

    word = "mask_stitch"
    variant = "wave"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 5e-4, 1e-2, amplitude=True),
        Parameter("period", "pixel", PERIODS[0], PERIODS[-1], step=0.01),
        Parameter("phase", "cycle", -0.5, 0.5, law="flat"),
        Parameter("along", "", 0, 1, law="whole"),
    )
    touches = ("flat_map",)
    needs: ClassVar[tuple[str, ...]] = ("pixels", "patterns")
    response = "quadratic"
    source = (
        "Periodic pixel sizes of LSST prototypes: Kotov et al. 2010, NIM A 652, 524; Smith & Rahmer "
        "2008, Proc. SPIE 7021; range assumed"
    )
    maps_vary = "nothing"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin with straight waves along an axis that were detected in the map of all wavelengths."""
        out = []
        for s in layout.sightings:
            if s["shape"] != "wave" or s["map"] != "all":
                continue
            f = np.array([s["fx"], s["fy"]], float)
            along = int(abs(f[1]) > abs(f[0]))
            n = layout.shape[1 - along]
            # Straight along the axis: crests tilt by less than one period across the sensor.
            if abs(f[1 - along]) * max(layout.shape) > 1:
                continue
            # The phase of a detected wave is that of the area's sine at the middle, pixel n / 2.
            turn = s["phase"] if f[along] > 0 else 0.5 - s["phase"]
            rate = abs(float(f[along]))
            phase = turn - rate * (n / 2 + 0.5) - 0.25
            out.append({
                "amp": float(s["amp"]) / (2 * np.sin(np.pi * rate)), "period": 1 / rate,
                "phase": (phase + 0.5) % 1.0 - 0.5, "along": float(along),
            })  # fmt: skip
        return out

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        n = ny if self["along"] else nx
        turn = np.arange(n + 1) / self["period"] + self["phase"]
        moved = self["amp"] * np.sin(2 * np.pi * turn)
        if self["along"]:
            return np.zeros((ny, nx + 1)), np.broadcast_to(moved[:, None], (ny + 1, nx))
        return np.broadcast_to(moved, (ny, nx + 1)), np.zeros((ny + 1, nx))
