"""A trap of fixed size at the end of the serial register."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Values


class TrapSerial(Effect):
    """A trap fills to ``size`` electrons at once and releases with ``tau`` pixel times.

    ``amp`` counts the amplifiers from zero.  Each row meets it empty: the parallel transfer
    takes far longer than the release.  Behind a row of light the first k-th pixel of the
    overscan holds size (1 - exp(-1/tau)) exp(-(k-1)/tau) electrons.
    """

    word = "trap_serial"
    stage = "shift"
    parameters = (
        Parameter("size", "e-", 5.0, 100.0, amplitude=True),
        Parameter("tau", "pixel times", 0.7, 4.0),
        Parameter("amp", "", 0, 1, law="whole"),
    )
    touches = ("serial_overscan",)
    source = (
        "Single-species trap with instant capture: ArCTIc, Massey et al. 2014, MNRAS 439, 887; "
        "fixed serial traps of ITL sensors: Snyder & Roodman 2019, Proc. SPIE 11117"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"size": 20.0, "tau": tau, "amp": float(n)}
            for n in range(len(layout.segments))
            for tau in (0.8, 1.5, 3.0)
        ]

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        size, tau = self["size"], self["tau"]
        if amp != int(self["amp"]) or size == 0:
            return frame
        out = np.empty_like(frame)
        held = np.zeros(len(frame))
        released = -np.expm1(-1 / tau)
        for column in range(frame.shape[1]):
            free = held * released
            held = held - free
            packet = frame[:, column]
            caught = np.clip(np.minimum(packet, size - held), 0, None)
            out[:, column] = packet - caught + free
            held = held + caught
        return out

    def serial_overscan(self, axes: Axes, layout: Layout) -> Values:
        # Full behind any light that exceeds it: the last pixel of a flat refills what it lost.
        held = np.minimum(self["size"], np.maximum(axes["level"], 0.0))
        fall = np.exp(-(axes["k"] - 1) / self["tau"])
        mine = axes["amp"].astype(int) == int(self["amp"])
        return np.where(mine, -np.expm1(-1 / self["tau"]) * held * fall, 0.0)
