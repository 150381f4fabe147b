"""Electronic memory: a fraction of the pixel read before remains in the amplifier."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Shot
from bfsensor.effects.transfer import trail_image
from bfsensor.typing import FloatArray


class ElectronicMemory(Effect):
    """The fraction ``alpha`` of the signal of the pixel read before is added to each pixel.

    It is the same in all columns, whereas charge left behind by transfers grows with the column.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``alpha``: 1e-05 to 0.001 (0 changes nothing).

    Examples
    --------
    >>> ElectronicMemory({"alpha": 0.0001}).name
    'electronic_memory'
    """

    word = "electronic_memory"
    parameters = (Parameter("alpha", "", 1e-5, 1e-3, amplitude=True),)
    touches = ("serial_overscan", "flat_mean", "flat_cov", "flat_map", "spot")
    source = (
        "Electronic offset drift of ITL sensors, here of one pixel: Snyder et al. 2021, JATIS 7, "
        "048002; range assumed"
    )

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        if self["alpha"] == 0:
            return frames
        out = []
        for frame in frames:
            before = np.zeros_like(frame)
            before.ravel()[1:] = frame.ravel()[:-1]
            out.append(frame + np.asarray(self["alpha"], frame.dtype) * before)
        return out

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        # The pixel before the first column, of the prescan or overscan, holds no light.
        out = np.zeros(layout.shape)
        for s in layout.segments:
            column = s.x + (s.columns - 1 if s.flip_x else 0)
            out[s.y : s.y + s.rows, column] = -self._share
        return out

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return level * (1.0 + self["alpha"])

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        # Each pixel is a weighted mean of two, as the gain is that of uniform light.
        both = np.roll(c, 1, -1) + np.roll(c, -1, -1)
        part = self._share
        return np.asarray(c + part * (1 - part) * (both - 2 * c))

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        return trail_image(images, self._share, layout.backwards("x"), -1)

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.where(axes["k"] == 1, self["alpha"] * axes["level"], 0.0)

    @property
    def _share(self) -> float:
        """Fraction of a uniform signal that is of the pixel before."""
        return self["alpha"] / (1.0 + self["alpha"])
