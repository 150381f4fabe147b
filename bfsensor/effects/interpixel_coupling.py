"""Interpixel coupling: each pixel passes a fixed fraction of its signal to its neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.typing import FloatArray


class InterpixelCoupling(Effect):
    """A pixel gives the fraction ``ax`` of its signal to each neighbour in x, ``ay`` to each in y.

    The coupling is linear: covariances of neighbours grow with the level, not with its square, and
    the variance per electron falls by the same fraction at all levels.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``ax``: 0.0003 to 0.003 (0 changes nothing); ``ay``: 0.0003 to 0.003 (0
        changes nothing).

    Examples
    --------
    >>> InterpixelCoupling({"ax": 0.0009, "ay": 0.0009}).name
    'interpixel_coupling'
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
        # Both pixels of a product are coupled, and the kernel is even: apply it twice.
        return self._coupled(self._coupled(c))

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        return self._coupled(images)

    def _coupled(self, image: Image) -> Image:
        """Image, or periodic covariances, after the coupling of its last two axes."""
        out = image
        for axis, name in ((-1, "ax"), (-2, "ay")):
            given = np.roll(image, 1, axis) + np.roll(image, -1, axis) - 2 * image
            out = out + self[name] * given
        return out
