"""Interpixel coupling: each pixel gives a constant part of its signal to its neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.typing import FloatArray


class InterpixelCoupling(Effect):
    """``ax`` of a pixel goes to either neighbour in the row, ``ay`` to either in the column.

    Linear and the same at all signals: covariances of neighbours grow with the level, not
    with its square, and the variance per electron falls at all levels alike.
    """

    word = "interpixel_coupling"
    stage = "store"
    parameters = (
        Parameter("ax", "", 3e-4, 3e-3, amplitude=True),
        Parameter("ay", "", 3e-4, 3e-3, amplitude=True),
    )
    touches = ("flat_cov", "spot")
    source = "Moore, Ninkov & Forrest 2004, Proc. SPIE 5167, 204; range of CCD video chains assumed"

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
        # The kernel with itself: coupled twice, for it is even.
        return self._coupled(self._coupled(c))

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        return self._coupled(images)

    def _coupled(self, image: Image) -> Image:
        out = image
        for axis, name in ((-1, "ax"), (-2, "ay")):
            given = np.roll(image, 1, axis) + np.roll(image, -1, axis) - 2 * image
            out = out + self[name] * given
        return out
