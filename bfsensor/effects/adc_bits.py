"""Errors of a converter: a bit has a wrong weight, moves codes by a constant, or makes wide codes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen
from bfsensor.typing import FloatArray

REMAINDERS = 64
"""Period [codes] of the remainders that the channel ``code_hist`` counts.

Defined by :data:`bfsensor.diagnose.data.code_channels.PERIOD`, which must be equal; bits of higher
weight show only below multiples of powers of two."""

LARGEST = 65536
"""Number of codes, defined by a converter of 16 bits; higher levels are cut off."""

READ_NOISE = 2.5
"""Read noise [ADU] of an amplifier whose noise is not known.

Chosen, as usual for CCD controllers: twice as large, the predicted dependence of the error on the
level practically vanishes for bit 2 and is a quarter as large for bit 3."""

STEPS = 3
"""Number of periods of the bit on either side of a level over which its mean error is summed.

Derived: noise above 0.75 periods takes the mean error instead, so that the first edge left out
lies at least 3 periods, or 4 sigma, away, where it changes the error by less than 1e-4 of delta."""


class AdcBits(Effect):
    """Bit ``bit`` of a successive-approximation converter weighs ``delta`` ADU too much.

    Codes with this bit set are ``delta`` too low: the code just below each odd multiple of 2^bit is
    wider by ``delta``, and ``delta`` codes below each multiple of 2^(bit + 1) never occur; the other
    way round for a negative ``delta``.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``delta`` [ADU]: 0.2 to 2 in magnitude, either sign (0 changes nothing);
        ``bit``: 2 to 9, whole.

    Examples
    --------
    >>> AdcBits({"delta": 0.6, "bit": 5}).name
    'adc_bits'
    """

    word = "adc_bits"
    stage = "converter"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("delta", "ADU", 0.2, 2.0, signed=True, amplitude=True),
        Parameter("bit", "", 2, 9, law="whole"),
    )
    touches: ClassVar[tuple[str, ...]] = (
        "code_hist",
        "flat_mean",
        "flat_cov",
        "bias_cov",
        "spot",
    )
    source = (
        "Counts of 0 and 1 by bit in flats: Abbott 1995, In-situ CCD testing (CTIO), bit biases; "
        "effects of converters on CCD data: Boone et al. 2018, PASP 130, 064504; range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        low, high = (int(v) for v in cls.parameters[1][2:4])
        return [
            {"delta": sign * 0.6, "bit": float(bit)}
            for bit in range(low, high + 1)
            for sign in (1, -1)
        ]

    def convert(self, levels: Image) -> Image:
        delta, half = self["delta"], 2.0 ** int(self["bit"])
        if delta == 0:
            return levels
        level = np.clip(levels + 0.5, 0, LARGEST - 1e-3)
        above = level % (2 * half)
        on = above >= half + delta
        # The bits below can hold no more than all ones.
        rest = np.minimum(np.floor(above - on * (half + delta)), half - 1)
        return level - above + on * half + rest

    def code_hist(self, axes: Axes, layout: Layout) -> FloatArray:
        code, bit, own = axes["code"].astype(int), axes["bit"].astype(int), int(self["bit"])
        out = np.zeros(len(code))
        high, half = bit >= 0, 2**own
        near = np.arange(-REMAINDERS // 2, REMAINDERS // 2)
        for edge, here in ((half, high & (bit == own)), (2 * half, high & (bit > own))):
            change = self._widths(edge + code[here])
            # The expected frequency is a mean over the codes beside, which the error changes too.
            total = float(self._widths(edge + near).sum()) if 2 * half > REMAINDERS else 0.0
            out[here] += (1 + change) / (1 + total / REMAINDERS) - 1
        if 2 * half <= REMAINDERS:
            out[~high] += self._widths(code[~high])
            return out
        # Some multiples of 64 are odd multiples of the bit and some even: their shares depend on
        # the levels of the flats.
        after = np.arange(REMAINDERS)
        # Codes of the second half of a period lie below the next multiple.
        after = np.where(after < REMAINDERS // 2, after, after - REMAINDERS)
        for amp in np.unique(axes["amp"]):
            mine = axes["amp"] == amp
            bits, first = np.unique(np.where(mine & high, bit, -1), return_index=True)
            share = dict(zip(bits.tolist(), axes["share"][first].tolist(), strict=True))
            even = sum(v for b, v in share.items() if b > own)
            change = share.get(own, 0.0) * self._widths(half + after)
            change = change + even * self._widths(2 * half + after)
            # Frequencies are relative to their mean: where one code rises, the others fall.
            change = (1 + change) / (1 + change.mean()) - 1
            rows = mine & ~high
            out[rows] += change[code[rows]]
        return out

    def bias_cov(self, axes: Axes, layout: Layout) -> FloatArray:
        out = np.zeros(len(axes["amp"]))
        if self["delta"] == 0 or not _known(layout):
            return out
        start, noise = self._zeros(layout)
        place = np.linspace(-6.0, 6.0, 2001)
        weight = np.exp(-(place**2) / 2) / np.exp(-(place**2) / 2).sum()
        levels = start[:, None] + noise[:, None] * place
        wrong, right = (
            weight @ (c - (c @ weight)[:, None]).T ** 2
            for c in (np.rint(self.convert(levels)), np.rint(levels))
        )
        change = np.array(layout.gains) ** 2 * (wrong - right)
        return np.where(axes["lag"] == 0, change[axes["amp"].astype(int)], out)

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        if self["delta"] == 0 or not _known(layout):
            return level
        start, noise = self._zeros(layout)
        error = self._error(start, noise)

        def read(amp: NDArray[np.int64]) -> FloatArray:
            return level + self._light_error(level, amp, layout) - gains[amp] * error[amp]

        gains = np.array(layout.gains)
        if "amp" in axes:
            return read(axes["amp"].astype(int))
        # Spots lie on all amplifiers: the mean over them.
        count = len(layout.segments)
        return np.asarray(np.mean([read(np.array(n)) for n in range(count)], axis=0))

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        if self["delta"] == 0 or not _known(layout):
            return c
        # The error is two-valued, with the mean of `mean`: a variance of its own.
        amp = axes["amp"].astype(int)
        mean = self._light_error(axes["level"], amp, layout)
        out = c.copy()
        out[:, 0, 0] -= mean * (self["delta"] * np.array(layout.gains)[amp] + mean)
        return out

    def _light_error(
        self, level: FloatArray, amp: NDArray[np.int64], layout: Layout
    ) -> FloatArray:
        """Mean error of the codes of pixels at a level with its shot and read noise [e-]."""
        gain, (start, noise) = np.array(layout.gains)[amp], self._zeros(layout)
        wide = np.sqrt(noise[amp] ** 2 + np.maximum(level, 0.0) / gain**2)
        return np.asarray(gain * self._error(start[amp] + level / gain, wide))

    def _zeros(self, layout: Layout) -> tuple[FloatArray, FloatArray]:
        """Levels before conversion without light, and read noise, by amplifier [ADU]."""
        zero = np.array(layout.offsets)
        noise = np.array(layout.read_noise or np.full(len(zero), READ_NOISE))
        noise = np.where(np.isfinite(noise) & (noise > 0), noise, READ_NOISE)
        return _levels(self, tuple(zero.tolist()), tuple(noise.tolist())), noise

    def _error(self, level: FloatArray, sigma: FloatArray) -> FloatArray:
        """Mean error of the codes [ADU] of levels [ADU] with Gaussian noise ``sigma`` [ADU]."""
        delta, period = self["delta"], 2.0 * 2 ** int(self["bit"])
        ends = self._ends()
        place = np.asarray(level % period)
        on = np.zeros(place.shape)
        for k in range(-STEPS, STEPS + 1):
            for sign, (where, slope) in zip((1, -1), ends, strict=True):
                wide = np.sqrt(sigma**2 + slope**2 / 12)
                on += sign * ndtr((place - where - k * period) / wide)
        even = (ends[1][0] - ends[0][0]) / period
        return np.asarray(-delta * np.where(sigma > 0.75 * period, even, on))

    def _ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Places in a period at which the bit is set and cleared, and the lengths of their ramps."""
        delta, half = self["delta"], 2.0 ** int(self["bit"])
        # One end of the set bit is a jump; at the other the wide code makes a ramp of length delta.
        if delta > 0:
            return (half - 1 + delta / 2, delta), (2 * half - 0.5, 0.0)
        return (half + delta - 0.5, 0.0), (2 * half - 1 + delta / 2, -delta)

    def _widths(self, place: NDArray[np.int64]) -> FloatArray:
        """Change of the frequency of codes by their place, counted from an even multiple of 2^bit."""
        delta, half = self["delta"], 2 ** int(self["bit"])
        place = np.asarray(place) % (2 * half)
        out = np.zeros(place.shape)
        for edge, odd in ((half, True), (2 * half, False)):
            below = edge - place
            if (delta > 0) == odd:
                change = np.where(below == 1, abs(delta), 0.0)
            else:
                change = -np.clip(abs(delta) - (below - 1.0), 0.0, 1.0)
            out += np.where((below >= 1) & (below <= half), change, 0.0)
        return out


class ShiftedCodes(AdcBits):
    """Codes with bit ``bit`` set are ``delta`` ADU too high: an offset is added after conversion.

    Then ``delta`` codes at odd multiples of 2^bit never occur, and as many at even ones occur twice as
    often; the other way round, below the multiples, for a negative ``delta``.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``delta`` [ADU]: 0.2 to 4 in magnitude, either sign (0 changes nothing);
        ``bit``: 1 to 14, whole.

    Examples
    --------
    >>> ShiftedCodes({"delta": 3.0, "bit": 5}).convert(np.array([31.2, 32.2]))
    array([31.2, 35.2])
    """

    variant = "shifted"
    parameters = (
        Parameter("delta", "ADU", 0.2, 4.0, signed=True, amplitude=True),
        Parameter("bit", "", 1, 14, law="whole"),
    )
    source = (
        "Offsets that depend on the bits of a code: Boone et al. 2018, PASP 130, 064504; sub-ranges of "
        "a converter that do not meet: IEEE Std 1241-2010, section 9.4; range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        low, high = (int(v) for v in cls.parameters[1][2:4])
        return [
            {"delta": delta, "bit": float(bit)}
            for bit in range(low, high + 1)
            for delta in (1.0, -1.0, 3.0, -3.0)
        ]

    def convert(self, levels: Image) -> Image:
        if self["delta"] == 0:
            return levels
        code = np.floor(np.clip(levels + 0.5, 0, LARGEST - 1e-3))
        half = 2.0 ** int(self["bit"])
        return levels + self["delta"] * (code % (2 * half) >= half)

    def _error(self, level: FloatArray, sigma: FloatArray) -> FloatArray:
        return -super()._error(level, sigma)

    def _ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        half = 2.0 ** int(self["bit"])
        return (half - 0.5, 0.0), (2 * half - 0.5, 0.0)

    def _widths(self, place: NDArray[np.int64]) -> FloatArray:
        delta, half = self["delta"], 2 ** int(self["bit"])
        place = np.asarray(place) % (2 * half)
        # Codes from half to period - 1 appear delta higher, some of them in the next period.
        first = half + delta + np.array([0, -2 * half])
        there = [
            np.clip(place + 1 - f, 0, 1) - np.clip(place + 1 - half - f, 0, 1)
            for f in first
        ]
        return np.asarray(there[0] + there[1] - (place >= half), float)


class WideCodes(AdcBits):
    """Every 2^bit-th code is ``delta`` ADU wider, at the cost of the next one.

    Every second code (``bit`` = 1) is no candidate: each fit has an excess of even codes.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``delta`` [ADU]: 0.05 to 1 in magnitude, either sign (0 changes nothing);
        ``bit``: 2 to 9, whole; ``place``: -1 to 0, whole: the wide codes are those just below
        multiples of 2^bit, or these themselves.

    Examples
    --------
    >>> WideCodes({"delta": 0.3, "bit": 2, "place": 0}).convert(np.array([4.7, 4.9]))
    array([4.4, 4.9])
    """

    variant = "wide"
    parameters = (
        Parameter("delta", "ADU", 0.05, 1.0, signed=True, amplitude=True),
        Parameter("bit", "", 2, 9, law="whole"),
        Parameter("place", "", -1, 0, law="whole"),
    )
    touches = ("code_hist",)
    source = "Differential nonlinearity: IEEE Std 1241-2010, section 9.4; range assumed"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        low, high = (int(v) for v in cls.parameters[1][2:4])
        return [
            {"delta": 0.3, "bit": float(bit), "place": float(place)}
            for bit in range(low, high + 1) for place in (-1, 0)
        ]  # fmt: skip

    def convert(self, levels: Image) -> Image:
        delta, half = self["delta"], 2 ** int(self["bit"])
        # Place above the transition from the wide code to the next one.
        above = (levels - 0.5 - self["place"]) % half
        if delta >= 0:
            return np.where(above < delta, levels - delta, levels)
        return np.where(above >= half + delta, levels - delta, levels)

    def bias_cov(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.zeros(len(axes["amp"]))

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        # The mean error, delta / 2^bit ADU in a pixel of 2^bit, is the same at all levels.
        return level

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return c

    def _widths(self, place: NDArray[np.int64]) -> FloatArray:
        half = 2 ** int(self["bit"])
        own = np.asarray(place - int(self["place"])) % half
        return np.asarray(self["delta"] * (1.0 * (own == 0) - (own == 1 % half)))


def _known(layout: Layout) -> bool:
    """Whether the mean codes without light are known for all amplifiers."""
    return bool(layout.offsets) and bool(np.isfinite(layout.offsets).all())


@lru_cache(maxsize=64)
def _levels(
    effect: AdcBits, zero: tuple[float, ...], noise: tuple[float, ...]
) -> FloatArray:
    """Levels before conversion [ADU] whose mean codes, with this error, are ``zero``; by bisection."""
    given, spread = np.array(zero), np.array(noise)
    reach = abs(effect["delta"])
    low, high = given - reach, given + reach
    for _ in range(40):
        middle = 0.5 * (low + high)
        more = middle + effect._error(middle, spread) < given
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.asarray(0.5 * (low + high))
