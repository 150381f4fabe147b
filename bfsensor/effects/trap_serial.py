"""Serial trap: a trap of fixed size at one place of the serial register of one amplifier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

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

COLUMN = Parameter("column", "", 0, 4095, law="whole", plain=0.0)
"""First column that passes the trap, in the order of reading.  Chosen: up to registers of sensors of 4k;
with twice as many, the evidence of a trap at one place falls by a factor of two."""


class TrapSerial(Effect):
    """A trap captures up to ``size`` electrons at once and releases them over ``tau`` pixel times.

    It captures only from the charge of a packet above ``reach`` electrons: it lies where smaller
    packets do not extend (0: it captures from all).  A sharp limit is assumed; flats hardly
    constrain it, and a capture that grows with the packet describes spots equally well.  ``amp``
    is the number of the amplifier, from 0.  The trap is empty at the beginning of each row, as the
    parallel transfer takes far longer than the release.  After a row of light the k-th pixel of
    the overscan holds size (1 - exp(-1/tau)) exp(-(k-1)/tau) electrons; the captured charge is
    missing in the first column that passes the trap, ``column``, counted from 0 as they are read:
    packets of the columns before it do not meet the trap.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``size`` [e-]: 5 to 100 (0 changes nothing); ``tau`` [pixel times]: 0.7
        to 4; ``amp``: 0 to 1, whole; ``reach`` [e-]: 0 to 1000; ``column``: 0 to 4095, whole, 0 if
        not given.

    Examples
    --------
    >>> TrapSerial({"size": 20.0, "tau": 2.0, "amp": 0, "reach": 500.0}).name
    'trap_serial'
    """

    word = "trap_serial"
    stage = "shift"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("size", "e-", 5.0, 100.0, amplitude=True),
        Parameter("tau", "pixel times", 0.7, 4.0),
        Parameter("amp", "", 0, 1, law="whole"),
        Parameter("reach", "e-", 0.0, 1000.0, law="flat", ends=(0.0, np.inf)),
        COLUMN,
    )
    touches = ("serial_overscan", "flat_map", "flat_mean", "spot")
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    source = (
        "Single-species trap with instant capture, beyond a depth in the well ('notch'): ArCTIc, "
        "Massey et al. 2014, MNRAS 439, 887; range of reach assumed; "
        "fixed serial traps of ITL sensors: Snyder & Roodman 2019, JATIS 5, 041509"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"size": 20.0, "tau": tau, "amp": float(n), "reach": 100.0, "column": column}
            for n, column in _places(layout, seen)
            for tau in (0.8, 1.5, 3.0)
        ]

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        if amp != int(self["amp"]) or self["size"] == 0:
            return frame
        first = int(self["column"])
        if not first:
            return self._through(frame)
        first += layout.segments[amp].prescan
        return np.concatenate([frame[:, :first], self._through(frame[:, first:])], axis=1)

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        segment = self._segment(layout)
        first = int(self["column"])
        if segment is None or shot.level <= 0 or first >= segment.columns:
            return None
        out = np.zeros(layout.shape)
        column = segment.x + (segment.columns - 1 - first if segment.flip_x else first)
        held = float(self._filled(np.array(shot.level)))
        out[segment.y : segment.y + segment.rows, column] = -held / shot.level
        return out

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        return -self._held(axes) / layout.of_amp("columns", axes["amp"])

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        # Full after any light above its size: the last pixel of a flat refills what it released.
        out = np.zeros(len(axes["k"]))
        for part, tau in self._species():
            out += part * -np.expm1(-1 / tau) * np.exp(-(axes["k"] - 1) / tau)
        return out * self._held(axes)

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        segment = self._segment(layout)
        if segment is None or self["size"] == 0:
            return images
        # Spots are so far apart that each meets the trap as the background leaves it; the
        # measurement is a mean over the spots of all amplifiers, those before the trap among them.
        share = (
            max(segment.columns - self["column"], 0.0)
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
        read = (self._through(lines, level[:, 0]) - level).reshape(images.shape)[..., order]
        return images + share * (read - images)

    def _through(self, frame: Image, level: FloatArray | None = None) -> Image:
        """Rows after the trap, first pixel first; ``level`` [e-] is read before, 0 by default."""
        out = np.array(frame, copy=True)
        for part, tau in self._species():
            released = -np.expm1(-1 / tau)
            held = np.zeros(len(frame))
            if level is not None:
                # The level fills the trap until it captures as much as it releases.
                held = self._before(level, part, released)
            for column in range(frame.shape[1]):
                free = held * released
                held = held - free
                caught = self._caught(frame[:, column], held, part)
                out[:, column] += free - caught
                held = held + caught
        return out

    def _species(self) -> tuple[tuple[float, float], ...]:
        """Parts of the trap, and their release times [pixel times]."""
        return ((1.0, self["tau"]),)

    def _caught(self, packet: FloatArray, held: FloatArray, part: float) -> FloatArray:
        """Charge that a part of the trap, which holds ``held``, takes from packets [e-]."""
        above = packet - self["reach"]
        return np.clip(np.minimum(above, part * self["size"] - held), 0, None)

    def _before(self, level: FloatArray, part: float, released: float) -> FloatArray:
        """Charge that a part of the trap holds after much light of a level [e-]."""
        reached = np.maximum(level - self["reach"], 0.0)
        return np.minimum(reached / released, part * self["size"])

    def _filled(self, level: FloatArray) -> FloatArray:
        """Charge in the trap after a flat of a level [e-]."""
        reached = np.maximum(level - self["reach"], 0.0)
        return np.minimum(self["size"], reached)

    def _held(self, axes: Axes) -> FloatArray:
        """Charge in the trap after the light of a flat [e-]; 0 in other amplifiers."""
        mine = axes["amp"].astype(int) == int(self["amp"])
        return np.where(mine, self._filled(axes["level"]), 0.0)

    def _segment(self, layout: Layout) -> Segment | None:
        """Amplifier of the trap; None if the sensor has no such amplifier."""
        n = int(self["amp"])
        return layout.segments[n] if n < len(layout.segments) else None


def _places(layout: Layout, seen: Sequence[Seen]) -> list[tuple[int, float]]:
    """Amplifiers with the first column read, and with single columns that stand out in maps."""
    out = [(n, 0.0) for n in range(len(layout.segments))]
    for strip in seen:
        low, high = strip.get("x", (0, 0))
        single = strip["word"] == "flat_map" and strip.get("what", "column") == "column"
        if not single or high - low != 1:
            continue
        for n, s in enumerate(layout.segments):
            read = (s.x + s.columns - 1 - low) if s.flip_x else low - s.x
            if 0 <= read < s.columns and (n, float(read)) not in out:
                out.append((n, float(read)))
        if len(out) >= len(layout.segments) + STRIPS:
            break
    return out


STRIPS = 4
"""Number of conspicuous columns that are tried as the place of a trap.  Chosen: a trap in two
amplifiers over one another is in four lists of maps; with 8, twice as many starts are predicted."""


CORNER = 2.0
"""Exponent that rounds the corner between the power of the signal and the full trap.

Chosen: with 1 the trap is half full at its ``middle`` and fills slowly (Hill's law), with 20 the
corner is sharp; the parameter ``corner`` is fitted from here."""


class GradualTrap(TrapSerial):
    r"""A trap that larger packets fill further, up to ``size``.

    It holds :math:`s\, x^p / (1 + x^{pc})^{1/c}` electrons after packets of S = x middle electrons: a
    power p of small packets, proportional for p = 1, a step for large p.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``size`` [e-]: 5 to 2000 (0 changes nothing); ``tau`` [pixel times]: 0.5 to
        20; ``amp``: 0 to 1, whole; ``middle`` [e-]: 300 to 100000; ``power``: 0.3 to 6; ``corner``:
        0.7 to 8; ``column``: 0 to 4095, whole, 0 if not given.

    Examples
    --------
    >>> values = {"size": 20.0, "tau": 2.0, "amp": 0, "middle": 2e4, "power": 1.0, "corner": 2.0}
    >>> GradualTrap(values).name
    'trap_serial:gradual'
    """

    variant = "gradual"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("size", "e-", 5.0, 2000.0, amplitude=True),
        Parameter("tau", "pixel times", 0.5, 20.0),
        Parameter("amp", "", 0, 1, law="whole"),
        Parameter("middle", "e-", 300.0, 1e5),
        Parameter("power", "", 0.3, 6.0),
        Parameter("corner", "", 0.7, 8.0),
        COLUMN,
    )
    source = (
        "Capture in proportion to the signal up to the trap's size, and by a logistic function of "
        "the signal: Snyder et al. 2021, JATIS 7, 048002, section 3; by the packet's volume, a power "
        "of the signal: Massey et al. 2014, MNRAS 439, 887"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"size": 50.0, "tau": 2.0, "amp": float(n), "middle": middle, "power": power,
             "corner": CORNER, "column": column} | cls._more()
            for n, column in _places(layout, seen)
            for middle, power in ((5e3, 1.0), (4e4, 1.0), (4e4, 4.0))
        ]  # fmt: skip

    @classmethod
    def _more(cls) -> dict[str, float]:
        """Start values of further parameters."""
        return {}

    def _filled(self, level: FloatArray) -> FloatArray:
        x = np.log(np.maximum(level, 1e-6) / self["middle"])
        power, corner = self["power"], self["corner"]
        return np.asarray(
            self["size"]
            * np.exp(power * x - np.logaddexp(0.0, power * corner * x) / corner)
        )

    def _caught(self, packet: FloatArray, held: FloatArray, part: float) -> FloatArray:
        room = np.minimum(part * self._filled(packet) - held, packet)
        return np.clip(room, 0, None)

    def _before(self, level: FloatArray, part: float, released: float) -> FloatArray:
        return part * self._filled(level)


class TwoTimesTrap(GradualTrap):
    """A gradual trap of which the part ``slow`` releases its charge over ``slow_tau``.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``size`` [e-]: 5 to 2000 (0 changes nothing); ``tau`` [pixel times]: 0.5 to
        20; ``amp``: 0 to 1, whole; ``middle`` [e-]: 300 to 100000; ``power``: 0.3 to 6; ``corner``:
        0.7 to 8; ``column``: 0 to 4095, whole, 0 if not given; ``slow``: 0.02 to 0.98;
        ``slow_tau`` [pixel times]: 2 to 50.

    Examples
    --------
    >>> values = {"size": 20.0, "tau": 2.0, "amp": 0, "middle": 2e4, "power": 1.0, "corner": 2.0}
    >>> TwoTimesTrap(values | {"slow": 0.3, "slow_tau": 9.0}).name
    'trap_serial:two_times'
    """

    variant = "two_times"
    parameters = (
        *GradualTrap.parameters,
        Parameter("slow", "", 0.02, 0.98, law="flat", ends=(0.0, 1.0)),
        Parameter("slow_tau", "pixel times", 2.0, 50.0),
    )
    source = (
        "Several traps with release times of their own: Snyder et al. 2021, JATIS 7, 048002, section "
        "3; ranges assumed"
    )

    @classmethod
    def _more(cls) -> dict[str, float]:
        return {"slow": 0.4, "slow_tau": 10.0, "tau": 1.0}

    def _species(self) -> tuple[tuple[float, float], ...]:
        slow = self["slow"]
        return (1 - slow, self["tau"]), (slow, self["slow_tau"])
