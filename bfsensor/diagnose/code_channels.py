"""The converter: how often each code comes, by its last bits; and crosstalk of spots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.conditions import Axes, Condition, Frame

PERIOD = 64
"""Codes that a wide distribution visits alike [ADU]."""

CLEAR = 7.0
"""Distance from an amplifier's own spots, and from its edges, over which spots of the next one
reach that it knows nothing of [pixel], from which on others' traces are sought."""

HALO_ERROR = 5e-6
"""Crosstalk for which unlike sides of spots' halos may be taken (assumed): 0.2 ADU of 40,000."""


class CodeChannels:
    """Counts codes of flats wide enough that every remainder is as likely as any other.

    A Gaussian of width s visits the remainders of P alike to 2 exp(-2 pi^2 s^2 / P^2): with
    s = 1.25 P to 1e-13.
    """

    def __init__(self, fold: str = "fit") -> None:
        self._fold = fold
        self._counts: dict[int, NDArray[np.int64]] = {}

    def add(self, frames: Sequence[Frame]) -> None:
        """Add a flat's raw codes."""
        for amp, frame in enumerate(frames):
            codes = frame.image[np.isfinite(frame.image)]
            middle = np.median(codes)
            width = 1.4826 * np.median(np.abs(codes - middle))
            if width < 1.25 * PERIOD:
                continue
            # Of struck pixels the distribution is another.
            inside = codes[np.abs(codes - middle) < 6 * width]
            remainder = np.bincount(inside.astype(np.int64) % PERIOD, minlength=PERIOD)
            self._counts[amp] = (
                self._counts.get(amp, np.zeros(PERIOD, np.int64)) + remainder
            )

    def channels(self) -> list[Channel]:
        """Share of each remainder over the even one, less one."""
        if not self._counts:
            return []
        values, blocks, axes = [], [], Axes()
        nothing = Condition(np.nan, np.nan, np.nan)
        for amp, counts in sorted(self._counts.items()):
            total = counts.sum()
            values.append(counts[:-1] * PERIOD / total - 1.0)
            # Multinomial; the last share follows from the others.
            n = PERIOD - 1
            blocks.append((PERIOD * np.eye(n) - 1.0) / total)
            axes.add(n, nothing, amp=amp, code=np.arange(n))
        return [Channel("code_hist", np.concatenate(values), tuple(blocks), axes.columns(), "",
                        self._fold)]  # fmt: skip


class CrosstalkChannels:
    """What one amplifier's bright pixels leave in the others', read out at the same time."""

    def __init__(self, fold: str = "fit") -> None:
        self._fold = fold
        self._sums: dict[tuple[int, int], tuple[float, float]] = {}

    def add(self, images: Sequence[NDArray[np.float64]], noise: Sequence[float]) -> None:
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
                r, c, y, x = rows[use], columns[use], y[use], x[use]
                dark = aggressor[y, x] < 0.01 * aggressor[r, c]
                r, c, y, x = r[dark], c[dark], y[dark], x[dark]
                s = aggressor[r, c]
                rest = victim[r, c] - victim[y, x]
                good = np.abs(rest) < 6 * np.sqrt(2.0) * noise[b] + 0.01 * s
                up, down = self._sums.get((a, b), (0.0, 0.0))
                weight = 0.5 / noise[b] ** 2
                self._sums[a, b] = (
                    up + weight * float(s[good] @ rest[good]),
                    down + weight * float(s[good] @ s[good]),
                )

    def channels(self) -> list[Channel]:
        """Fraction of amplifier ``amp`` seen in ``other``."""
        if not self._sums:
            return []
        axes = Axes()
        nothing = Condition(np.nan, np.nan, np.nan)
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


def _spots(signal: NDArray[np.float64], threshold: float) -> NDArray[np.int64]:
    """Rows and columns of the peaks of spots, shape (n, 2)."""
    peaks = (signal == maximum_filter(signal, 9)) & (signal > threshold)
    return np.argwhere(peaks)
