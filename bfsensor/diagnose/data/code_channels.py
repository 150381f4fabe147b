"""The converter: how often each code comes, by its last bits; and crosstalk of spots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import Axes, Frame
from bfsensor.typing import FloatArray

PERIOD = 64
"""Codes that a wide distribution visits alike [ADU]."""

BITS = (6, 7, 8, 9, 10)
"""Powers of two that multiples of :data:`PERIOD` are told apart by: 10 and beyond together."""

BELOW = (1, 2)
"""Codes below a multiple that a wrong weight of a bit widens or skips: errors to 2 codes."""

_BOX = np.concatenate([[0.5], np.ones(PERIOD - 1), [0.5]]) / PERIOD
SMOOTH = 2 * np.pad(_BOX, PERIOD // 2) - np.convolve(_BOX, _BOX)
"""Weights of the codes around that tell how often one should come: of any pattern of period 64
the mean, of a parabola its value."""

CLEAR = 7.0
"""Distance from an amplifier's own spots, and from its edges, over which spots of the next one
reach that it knows nothing of [pixel], from which on others' traces are sought."""

HALO_ERROR = 5e-6
"""Crosstalk for which unlike sides of spots' halos may be taken (assumed): 0.2 ADU of 40,000."""


PILE = 16
"""Codes that full pixels lie within: read noise, some ADU wide."""


def _piled(counts: NDArray[np.int64], width: float) -> bool:
    """Whether pixels pile up at one level, as where part of them are full.

    Twice what a Gaussian of that width has at its middle, and no chance.
    """
    most = float(np.convolve(counts, np.ones(PILE), "valid").max(initial=0.0))
    expected = float(counts.sum()) * PILE / (np.sqrt(2 * np.pi) * width)
    return most > 2 * expected + 6 * np.sqrt(expected)


TAIL = 2.75
"""Widths from the middle beyond which flats' codes are few, and full ones are none."""


def _cut_off(codes: NDArray[np.float32], middle: float, width: float) -> bool:
    """Whether the upper tail is missing beside the lower one, as where its pixels are full.

    So few pile up in a flat whose mean is two or three widths below the full well that no pile
    shows, but the codes below powers of two have lost what is piled.  Half, and no chance.
    """
    away = (codes - middle) / width
    low, high = int((away < -TAIL).sum()), int((away > TAIL).sum())
    return high < 0.5 * low and low - high > 6 * np.sqrt(low + high)


class CodeChannels:
    """Counts codes of flats wide enough that every remainder is as likely as any other.

    A Gaussian of width s visits the remainders of P alike to 2 exp(-2 pi^2 s^2 / P^2): with
    s = 1.25 P to 1e-13.
    """

    def __init__(self, fold: str = "fit") -> None:
        self._fold = fold
        self._counts: dict[int, NDArray[np.int64]] = {}
        self._piled: dict[int, int] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Which flats were left out, in words."""
        if not self._piled:
            return ()
        told = ", ".join(
            f"{n} of amplifier {amp}" for amp, n in sorted(self._piled.items())
        )
        return (
            f"{self._fold} fold: flats whose brightest codes pile up or are missing, as of full "
            f"pixels, are left out of the histogram of codes: {told}",
        )

    def add(self, frames: Sequence[Frame]) -> None:
        """Add a flat's raw codes."""
        for amp, frame in enumerate(frames):
            codes = frame.image[np.isfinite(frame.image)]
            middle = np.median(codes)
            width = 1.4826 * np.median(np.abs(codes - middle))
            if width < 1.25 * PERIOD:
                continue
            # Of struck pixels the distribution is another; below 0 no converter counts.
            inside = codes[np.abs(codes - middle) < 6 * width].astype(np.int64)
            counts = np.bincount(inside[inside >= 0])
            if _piled(counts, width) or _cut_off(codes, float(middle), width):
                self._piled[amp] = self._piled.get(amp, 0) + 1
                continue
            kept = self._counts.get(amp, np.zeros(0, np.int64))
            size = -(-max(len(kept), len(counts)) // PERIOD) * PERIOD
            total = np.zeros(size, np.int64)
            total[: len(kept)] += kept
            total[: len(counts)] += counts
            self._counts[amp] = total

    def channels(self) -> list[Channel]:
        """Share of each remainder over the even one, less one; and codes below high powers of two."""
        if not self._counts:
            return []
        values, blocks, axes = [], [], Axes()
        nothing = Condition()
        for amp, codes in sorted(self._counts.items()):
            counts = codes.reshape(-1, PERIOD).sum(0)
            total = counts.sum()
            values.append(counts[:-1] * PERIOD / total - 1.0)
            # Multinomial; the last share follows from the others.
            n = PERIOD - 1
            blocks.append((PERIOD * np.eye(n) - 1.0) / total)
            axes.add(n, nothing, amp=amp, code=np.arange(n), bit=-1, share=0.0)
            steps = _steps(codes)
            for bit, (low, expected, share) in steps.items():
                # One more than expected: none may be where a flat hardly reaches.
                values.append((low - expected) / (expected + 1.0))
                scale = np.sqrt(expected + 1.0)
                shared = float(SMOOTH @ SMOOTH)
                blocks.append((np.eye(len(BELOW)) + shared) / np.outer(scale, scale))
                axes.add(
                    len(BELOW),
                    nothing,
                    amp=amp,
                    code=-np.array(BELOW),
                    bit=bit,
                    share=share,
                )
        return [Channel("code_hist", np.concatenate(values), tuple(blocks), axes.columns(), "",
                        self._fold)]  # fmt: skip


def _steps(
    codes: NDArray[np.int64],
) -> dict[int, tuple[NDArray[np.int64], FloatArray, float]]:
    """Of each of :data:`BITS`: counts below its multiples, those expected, share of all multiples."""
    multiple = np.arange(PERIOD, len(codes), PERIOD)
    # The highest power of two in each, by its lowest bit.
    bit = np.minimum(np.log2(multiple & -multiple).astype(int), BITS[-1])
    smooth = np.maximum(np.convolve(codes, SMOOTH, "same"), 0.0)
    out = {}
    for b in BITS:
        own = multiple[bit == b]
        low, mean = (np.array([h[own - k].sum() for k in BELOW]) for h in (codes, smooth))
        share = float(smooth[own].sum() / max(smooth[multiple].sum(), 1e-9))
        out[b] = low, mean, share
    return out


class CrosstalkChannels:
    """What one amplifier's bright pixels leave in the others', read out at the same time."""

    def __init__(self, fold: str = "fit") -> None:
        self._fold = fold
        self._sums: dict[tuple[int, int], tuple[float, float]] = {}

    def add(self, images: Sequence[FloatArray], noise: Sequence[float]) -> None:
        """Add an exposure of spots.

        Parameters
        ----------
        images : sequence of ndarray
            Of each amplifier in readout order, bias subtracted [ADU].
        noise : sequence of float
            Read noise of each [ADU].
        """
        levels = [float(np.nanmedian(i)) for i in images]
        signals = [
            np.nan_to_num(i - level) for i, level in zip(images, levels, strict=True)
        ]
        centres = [_spots(s, 100 * n) for s, n in zip(signals, noise, strict=True)]
        for a, aggressor in enumerate(signals):
            threshold = max(0.2 * float(np.percentile(aggressor, 99.9)), 100 * noise[a])
            rows, columns = np.nonzero(aggressor > threshold)
            for b, victim in enumerate(signals):
                if a == b or len(rows) < 20 or len(centres[b]) < 4:
                    continue
                # A spot's halo is alike on both sides: the point across the victim's own spot
                # has the same halo and, mostly, no light in the other amplifier.
                distance, which = cKDTree(centres[b]).query(
                    np.column_stack([rows, columns])
                )
                y, x = (2 * centres[b][which] - np.column_stack([rows, columns])).T
                use = (
                    (distance > CLEAR)
                    & _is_inside(rows, columns, victim.shape)
                    & _is_inside(y, x, victim.shape)
                )
                aside = columns - centres[b][which][:, 1]
                r, c, y, x, aside = rows[use], columns[use], y[use], x[use], aside[use]
                dark = aggressor[y, x] < 0.01 * aggressor[r, c]
                r, c, y, x, aside = r[dark], c[dark], y[dark], x[dark], aside[dark]
                s = aggressor[r, c]
                rest = victim[r, c] - victim[y, x]
                good = np.abs(rest) < 6 * np.sqrt(2.0) * noise[b] + 0.01 * s
                up, down = self._sums.get((a, b), (0.0, 0.0))
                weight = 0.5 / noise[b] ** 2
                both = _without_trails(aside[good], s[good], rest[good])
                self._sums[a, b] = up + weight * both[0], down + weight * both[1]

    def channels(self) -> list[Channel]:
        """Fraction of amplifier ``amp`` seen in ``other``."""
        if not self._sums:
            return []
        axes = Axes()
        nothing = Condition()
        pairs = sorted(p for p, (_, down) in self._sums.items() if down > 0)
        values = np.array([self._sums[p][0] / self._sums[p][1] for p in pairs])
        axes.add(len(pairs), nothing, amp=[p[0] for p in pairs], other=[p[1] for p in pairs],
                 what="crosstalk")  # fmt: skip
        blocks = tuple(np.array([[1.0 / self._sums[p][1] + HALO_ERROR**2]]) for p in pairs)
        return [Channel("amp_cross", values, blocks, axes.columns(), "", self._fold)]


def _is_inside(
    y: NDArray[np.int64], x: NDArray[np.int64], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Whether pixels lie clear of an image's edges."""
    ny, nx = shape
    return (y >= CLEAR) & (y < ny - CLEAR) & (x >= CLEAR) & (x < nx - CLEAR)


def _without_trails(
    aside: NDArray[np.int64], s: FloatArray, rest: FloatArray
) -> tuple[float, float]:
    """Sums of s times rest and of s squared, both less their means at each distance in x.

    What a register trails behind the victim's own spot depends on the distance from it in x, not
    on the light in the other amplifier.
    """
    _, group = np.unique(aside, return_inverse=True)
    group = group.ravel()
    count = np.maximum(np.bincount(group), 1)
    s, rest = (v - (np.bincount(group, v) / count)[group] for v in (s, rest))
    return float(s @ rest), float(s @ s)


def _spots(signal: FloatArray, threshold: float) -> NDArray[np.int64]:
    """Rows and columns of the peaks of spots, shape (n, 2)."""
    peaks = (signal == maximum_filter(signal, 9)) & (signal > threshold)
    return np.argwhere(peaks)
