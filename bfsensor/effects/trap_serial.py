"""Serial trap: a trap of fixed size at the end of the serial register of one amplifier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bfsensor.effects.effect import (
    Axes,
    Effect,
    Image,
    Layout,
    Parameter,
    Seen,
    Segment,
    Shot,
)
from bfsensor.typing import FloatArray


class TrapSerial(Effect):
    """A trap captures up to ``size`` electrons at once and releases them over ``tau`` pixel times.

    It captures only from the charge of a packet above ``reach`` electrons: it lies where smaller
    packets do not extend (0: it captures from all).  A sharp limit is assumed; flats hardly
    constrain it, and a capture that grows with the packet describes spots equally well.  ``amp``
    is the number of the amplifier, from 0.  The trap is empty at the beginning of each row, as the
    parallel transfer takes far longer than the release.  After a row of light the k-th pixel of
    the overscan holds size (1 - exp(-1/tau)) exp(-(k-1)/tau) electrons; the captured charge is
    missing in the first column.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``size`` [e-]: 5 to 100 (0 changes nothing); ``tau`` [pixel times]: 0.7
        to 4; ``amp``: 0 to 1, whole; ``reach`` [e-]: 0 to 1000.

    Examples
    --------
    >>> TrapSerial({"size": 20.0, "tau": 2.0, "amp": 0, "reach": 500.0}).name
    'trap_serial'
    """

    word = "trap_serial"
    stage = "shift"
    parameters = (
        Parameter("size", "e-", 5.0, 100.0, amplitude=True),
        Parameter("tau", "pixel times", 0.7, 4.0),
        Parameter("amp", "", 0, 1, law="whole"),
        Parameter("reach", "e-", 0.0, 1000.0, law="flat"),
    )
    touches = ("serial_overscan", "flat_map", "flat_mean", "spot")
    of_pixels = True
    source = (
        "Single-species trap with instant capture, beyond a depth in the well ('notch'): ArCTIc, "
        "Massey et al. 2014, MNRAS 439, 887; range of reach assumed; "
        "fixed serial traps of ITL sensors: Snyder & Roodman 2019, JATIS 5, 041509"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"size": 20.0, "tau": tau, "amp": float(n), "reach": 100.0}
            for n in range(len(layout.segments))
            for tau in (0.8, 1.5, 3.0)
        ]

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        if amp != int(self["amp"]) or self["size"] == 0:
            return frame
        return self._through(frame)

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        segment = self._segment(layout)
        if segment is None or shot.level <= 0:
            return None
        out = np.zeros(layout.shape)
        column = segment.x + (segment.columns - 1 if segment.flip_x else 0)
        held = min(self["size"], max(shot.level - max(self["reach"], 0.0), 0.0))
        out[segment.y : segment.y + segment.rows, column] = -held / shot.level
        return out

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        return -self._held(axes) / layout.of_amp("columns", axes["amp"])

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        # Full after any light above its size: the last pixel of a flat refills what it released.
        fall = np.exp(-(axes["k"] - 1) / self["tau"])
        return -np.expm1(-1 / self["tau"]) * self._held(axes) * fall

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        segment = self._segment(layout)
        if segment is None or self["size"] == 0:
            return images
        # Spots are so far apart that each meets the trap as the background leaves it; the
        # measurement is a mean over the spots of all amplifiers.
        share = (
            segment.columns
            * segment.rows
            / sum(s.columns * s.rows for s in layout.segments)
        )
        order = slice(None, None, -1 if segment.flip_x else 1)
        # The background fills the trap until it captures as much as it releases.
        level = axes.get("background", 0.0) * images.sum((-2, -1), keepdims=True)
        level = np.maximum(
            np.broadcast_to(level, (*images.shape[:-1], 1)).reshape(-1, 1), 0.0
        )
        lines = images[..., order].reshape(-1, images.shape[-1]) + level
        reached = np.maximum(level[:, 0] - max(self["reach"], 0.0), 0.0)
        held = np.minimum(reached / -np.expm1(-1 / self["tau"]), self["size"])
        read = (self._through(lines, held) - level).reshape(images.shape)[..., order]
        return images + share * (read - images)

    def _through(self, frame: Image, held: FloatArray | None = None) -> Image:
        """Rows after the trap, first pixel first; ``held`` [e-] is in the trap before, 0 by default."""
        size, reach = self["size"], max(self["reach"], 0.0)
        out = np.empty_like(frame)
        held = np.zeros(len(frame)) if held is None else held
        released = -np.expm1(-1 / self["tau"])
        for column in range(frame.shape[1]):
            free = held * released
            held = held - free
            packet = frame[:, column]
            caught = np.clip(np.minimum(packet - reach, size - held), 0, None)
            out[:, column] = packet - caught + free
            held = held + caught
        return out

    def _held(self, axes: Axes) -> FloatArray:
        """Charge in the trap after the light of a flat [e-]; 0 in other amplifiers."""
        mine = axes["amp"].astype(int) == int(self["amp"])
        reached = axes["level"] - max(self["reach"], 0.0)
        held = np.minimum(self["size"], np.maximum(reached, 0.0))
        return np.where(mine, held, 0.0)

    def _segment(self, layout: Layout) -> Segment | None:
        """Amplifier of the trap; None if the sensor has no such amplifier."""
        n = int(self["amp"])
        return layout.segments[n] if n < len(layout.segments) else None
