"""Edge roll-off: near the rim of the sensor a lateral field moves pixel edges outwards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges, FloatArray

EXPONENTIAL = 0.1
"""Tail below which the law is called an exponential.  Derived: powers of more than ten differ from an
exponential by less than 5 % of ``amp``."""


class EdgeRolloff(Effect):
    r"""Edges at the distance d from the rim are moved outwards, less the farther they lie inside.

    .. math:: u(d) = A \left( 1 + t\, \frac{d}{L} \right)^{-1/t}

    ``length`` L is the decay length at the rim.  ``tail`` t is 0 for an exponential and 1 / p for a
    power p of the distance, (1 + d / (p L))^-p.  ``amp`` A is below 0 for a displacement inwards; edges
    between columns, near the sides, have (1 + ``sides``) A, those between rows (1 - ``sides``) A.  The
    outermost boundary itself is displaced where ``rim`` is 1, and held by the guard ring where it is 0.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.01 to 0.5 in magnitude, either sign (0 changes nothing);
        ``length`` [pixel]: 1.5 to 8; ``sides``: -1 to 1; ``tail``: 0 to 1; ``rim``: 0 to 1, whole.

    Examples
    --------
    >>> EdgeRolloff({"amp": 0.07, "length": 3.0}).law_name
    'exponential'
    """

    word = "edge_rolloff"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 0.01, 0.5, signed=True, amplitude=True),
        Parameter("length", "pixel", 1.5, 8.0),
        Parameter("sides", "", -1.0, 1.0, law="flat", plain=0.0),
        Parameter("tail", "", 0.0, 1.0, law="flat", plain=0.0, ends=(0.0, 1.0)),
        Parameter("rim", "", 0, 1, law="whole", plain=1.0),
    )
    touches = ("flat_map",)
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    response = "quadratic"
    source = (
        "Spots displaced near the edge of an LSST prototype: Bradshaw et al. 2015, JINST 10, C04034 "
        "(arXiv 1507.02683); glowing edges of DECam: Plazas, Bernstein & Sheldon 2014, JINST 9, C04001; "
        "a power of the distance for a line charge outside the rim, an exponential for a screened one: "
        "electrostatics; range assumed"
    )
    maps_vary = "nothing"

    @property
    def law_name(self) -> str:
        """'exponential' or 'power', whichever the tail is nearer to."""
        return "exponential" if self["tail"] < EXPONENTIAL else "power"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"amp": 0.05, "length": length, "sides": 0.0, "tail": tail, "rim": rim}
            for length in (1.7, 2.6, 4.0, 6.3) for tail in (0.1, 0.5) for rim in (1.0, 0.0)
        ]  # fmt: skip

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        x, y = (
            (1 + sign * self["sides"]) * self._outwards(n)
            for sign, n in ((1, nx), (-1, ny))
        )
        return (
            np.broadcast_to(x, (ny, nx + 1)),
            np.broadcast_to(y[:, None], (ny + 1, nx)),
        )

    def _outwards(self, n: int) -> np.ndarray:
        """Displacements of the n + 1 edges of n pixels [pixel], positive towards larger numbers."""
        edge = np.arange(n + 1.0)
        out = self._fallen(n - edge) - self._fallen(edge)
        if not self["rim"]:
            out[[0, -1]] = 0.0
        return np.asarray(self["amp"] * out)

    def _fallen(self, away: FloatArray) -> FloatArray:
        """Profile at a distance from the rim [pixel], 1 at the rim."""
        d, t = away / self["length"], self["tail"]
        if abs(t) < 1e-6:
            return np.asarray(np.exp(-d))
        # With a negative tail, which fits may try, the profile ends at a distance.
        return np.asarray(np.exp(-np.log(np.maximum(1 + t * d, 1e-12)) / t))
