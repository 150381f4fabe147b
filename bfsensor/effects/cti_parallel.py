"""Parallel charge transfer inefficiency: charge left behind at each transfer along the columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen
from bfsensor.effects.transfer import (
    SLOWER,
    TRAPS,
    Traps,
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


class ParallelTraps(Traps):
    """Traps in the columns: a power of the signal, released over several packets.

    The equations are those of :class:`bfsensor.effects.transfer.Traps`.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``cti``: 1e-07 to 5e-06 at 5e4 e- (0 changes nothing); ``power``: 0.2 to
        1.2, of the signal; ``tau`` [packets]: 0.3 to 10.

    Examples
    --------
    >>> ParallelTraps({"cti": 7e-07, "power": 0.6, "tau": 2.0}).name
    'cti_parallel:traps'
    """

    word = "cti_parallel"
    variant = "traps"
    axis = 0
    parameters: ClassVar[tuple[Parameter, ...]] = TRAPS
    touches = ("parallel_overscan", "flat_cov", "spot")
    source = (
        "Volume of a packet as a power of its charge, exponential release: Short et al. 2013, "
        "MNRAS 430, 3078; Massey et al. 2014, MNRAS 439, 887"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"cti": 1e-6, "power": power, "tau": tau}
            for power in (0.5, 1.0)
            for tau in (0.5, 3.0)
        ]

    def parallel_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        return self._overscan(axes, layout)


class TwoParallelTraps(ParallelTraps):
    """Two kinds of traps in the columns, which release the part ``slow`` over ``slow_tau``.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``cti``: 1e-07 to 5e-06 at 5e4 e- (0 changes nothing); ``power``: 0.2 to
        1.2, of the signal; ``tau`` [packets]: 0.3 to 10; ``slow``: 0.02 to 0.98; ``slow_tau``
        [packets]: 2 to 40.

    Examples
    --------
    >>> values = {"cti": 7e-07, "power": 0.6, "tau": 1.0, "slow": 0.4, "slow_tau": 8.0}
    >>> TwoParallelTraps(values).name
    'cti_parallel:two_traps'
    """

    variant = "two_traps"
    parameters = (*TRAPS, *SLOWER)
    source = (
        "Several species of traps with release times of their own: Massey et al. 2014, MNRAS 439, "
        "887, section 2"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"cti": 1e-6, "power": power, "tau": 0.7, "slow": 0.3, "slow_tau": 7.0}
            for power in (0.5, 1.0)
        ]
