"""Edge roll-off: near the rim of the sensor a lateral field moves pixel edges outwards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import Edges


class EdgeRolloff(Effect):
    """Edges at the distance d from the rim are moved outwards by ``amp`` exp(-d / length) pixels.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp`` [pixel]: 0.01 to 0.5 (0 changes nothing); ``length`` [pixel]: 1.5
        to 8.

    Examples
    --------
    >>> EdgeRolloff({"amp": 0.07, "length": 3.0}).name
    'edge_rolloff'
    """

    word = "edge_rolloff"
    stage = "collect"
    parameters = (
        Parameter("amp", "pixel", 0.01, 0.5, amplitude=True),
        Parameter("length", "pixel", 1.5, 8.0),
    )
    touches = ("flat_map",)
    of_pixels = True
    bends = True
    source = (
        "Bradshaw et al. 2015, JINST 10, C04034 (arXiv 1507.02683): spots displaced near the edge of "
        "an LSST prototype; an exponential and its range are assumed"
    )
    standing = True

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"amp": 0.05, "length": length} for length in (1.7, 2.6, 4.0, 6.3)]

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        ny, nx = layout.shape
        x, y = (self._outwards(n) for n in (nx, ny))
        return (
            np.broadcast_to(x, (ny, nx + 1)),
            np.broadcast_to(y[:, None], (ny + 1, nx)),
        )

    def _outwards(self, n: int) -> np.ndarray:
        """Displacements of the n + 1 edges of n pixels [pixel], positive towards larger numbers."""
        edge, length = np.arange(n + 1.0), self["length"]
        return np.asarray(
            self["amp"] * (np.exp((edge - n) / length) - np.exp(-edge / length))
        )
