"""Interpixel coupling: each pixel passes a fixed fraction of its signal to its neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

REACH = 3
"""Largest distance of pixels that are coupled [pixel].  Derived: at the top of the decay's range, a
half, a pixel four away is given an eighth of the fraction at one pixel, and its covariances are as
faint."""


class InterpixelCoupling(Effect):
    """A pixel gives the fraction ``ax`` of its signal to each neighbour in x, ``ay`` to each in y.

    Pixels at other distances r, up to three, are given as much times ``decay`` to the power r - 1, of
    ``ax`` and ``ay`` by the squares of the direction's cosines; with a decay of 0 nothing.
    The coupling is linear: covariances of neighbours grow with the level, not with its square, and
    the variance per electron falls by the same fraction at all levels.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``ax``: 0.0003 to 0.003 (0 changes nothing); ``ay``: 0.0003 to 0.003 (0
        changes nothing); ``decay``: 0 to 0.5.

    Examples
    --------
    >>> InterpixelCoupling({"ax": 0.0009, "ay": 0.0009}).law_name
    'four_neighbours'
    """

    word = "interpixel_coupling"
    stage = "store"
    parameters = (
        Parameter("ax", "", 3e-4, 3e-3, amplitude=True),
        Parameter("ay", "", 3e-4, 3e-3, amplitude=True),
        Parameter("decay", "", 0.0, 0.5, law="flat", plain=0.0, ends=(0.0, 1.0)),
    )
    touches = ("flat_cov", "spot")
    in_areas = True
    source = (
        "Four neighbours: Moore, Ninkov & Forrest 2004, Proc. SPIE 5167, 204; diagonal and farther "
        "ones: Giannini et al. 2013, Exp. Astron. 36, 1; Donlon et al. 2016; range of CCD video chains "
        "assumed"
    )

    @property
    def law_name(self) -> str:
        """'extended' if a diagonal neighbour is given more than a tenth of what a near one is."""
        return (
            "extended"
            if self["decay"] > 0.1 ** (1 / (np.sqrt(2.0) - 1))
            else "four_neighbours"
        )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"ax": 1e-3, "ay": 1e-3, "decay": decay} for decay in (0.0, 0.25)]

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, Image],
    ) -> Image:
        del shot, layout, rng, memory
        return self._coupled(charge)

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        # Both pixels of a product are coupled, and the kernel is even: apply it twice.
        return self._coupled(self._coupled(c))

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        return self._coupled(images)

    def _coupled(self, image: Image) -> Image:
        """Image, or periodic covariances, after the coupling of its last two axes."""
        out = image
        reach = REACH if self["decay"] else 1
        for j in range(-reach, reach + 1):
            for i in range(-reach, reach + 1):
                square = i * i + j * j
                if not 0 < square <= reach * reach:
                    continue
                near = (self["ax"] * i * i + self["ay"] * j * j) / square
                part = near * (
                    self["decay"] ** (np.sqrt(square) - 1) if square > 1 else 1.0
                )
                out = out + part * (np.roll(image, (j, i), (-2, -1)) - image)
        return out
