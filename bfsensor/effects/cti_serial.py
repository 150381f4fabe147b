"""Serial charge transfer inefficiency: charge left behind at each transfer along the rows."""

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


class CtiSerial(Effect):
    """Each serial transfer leaves the fraction ``cti`` of the charge to the next packet.

    The pixel in column c, prescan included, has c + 1 transfers.  After a flat the first pixel of
    the overscan holds the fraction N cti of the level, N being the transfers of the last column.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``cti``: 1e-07 to 5e-06 (0 changes nothing).

    Examples
    --------
    >>> CtiSerial({"cti": 7e-07}).name
    'cti_serial'
    """

    word = "cti_serial"
    stage = "shift"
    parameters = (Parameter("cti", "", 1e-7, 5e-6, amplitude=True),)
    touches = ("serial_overscan", "flat_cov", "spot")
    source = (
        "Janesick 2001, Scientific Charge-Coupled Devices, SPIE Press, chapter 5; proportional "
        "loss of LSST sensors: Snyder & Roodman 2019, JATIS 5, 041509"
    )

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        return leave_behind(frame, self["cti"], 1)

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        columns, before = (layout.of_amp(n, axes["amp"]) for n in ("columns", "prescan"))
        return axes["level"] * behind_flat(axes["k"], columns, before, self["cti"])

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        columns, before = (layout.of_amp(n, axes["amp"]) for n in ("columns", "prescan"))
        return trail_covariances(c, self["cti"] * (before + (columns + 1) / 2), -1)

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        mean = np.mean([s.prescan + (s.columns + 1) / 2 for s in layout.segments])
        return trail_image(images, self["cti"] * float(mean), layout.backwards("x"), -1)
