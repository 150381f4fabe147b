"""Parallel charge transfer inefficiency: charge left behind at each transfer along the columns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter
from bfsensor.effects.transfer import (
    behind_flat,
    leave_behind,
    trail_covariances,
    trail_image,
)
from bfsensor.typing import FloatArray


class CtiParallel(Effect):
    """Each parallel transfer leaves the fraction ``cti`` of the charge to the next packet.

    The pixel in row r has r + 1 transfers.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``cti``: 1e-07 to 5e-06 (0 changes nothing).

    Examples
    --------
    >>> CtiParallel({"cti": 7e-07}).name
    'cti_parallel'
    """

    word = "cti_parallel"
    stage = "shift"
    parameters = (Parameter("cti", "", 1e-7, 5e-6, amplitude=True),)
    touches = ("parallel_overscan", "flat_cov", "spot")
    source = (
        "Janesick 2001, Scientific Charge-Coupled Devices, SPIE Press, chapter 5 (1e-6 to 1e-5 "
        "of good buried channels); lower end assumed"
    )

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        return leave_behind(frame, self["cti"], 0)

    def parallel_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        rows = layout.of_amp("rows", axes["amp"])
        return axes["level"] * behind_flat(axes["k"], rows, 0 * rows, self["cti"])

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        rows = layout.of_amp("rows", axes["amp"])
        return trail_covariances(c, self["cti"] * (rows + 1) / 2, -2)

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        mean = np.mean([(s.rows + 1) / 2 for s in layout.segments])
        return trail_image(images, self["cti"] * float(mean), layout.backwards("y"), -2)
