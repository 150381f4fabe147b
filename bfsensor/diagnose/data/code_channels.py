"""Channels of the analogue-to-digital converter (histogram of codes) and of crosstalk of spots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.cosmetics import recoded_of
from bfsensor.diagnose.data.exposure_info import Axes, Frame
from bfsensor.measure.spots import find_peaks
from bfsensor.typing import FloatArray

PERIOD = 64
"""Number of remainders of a code whose frequencies are measured [ADU].  Chosen: 64 holds the six
lowest bits, whose codes flats of 1.25 periods width visit alike; with 128, only flats of twice the
width, four times the signal, could be used."""

BITS = range(6, 16)
"""Bits by which multiples of :data:`PERIOD` are separated.  Derived: all of a converter of 16 bits above
the remainders; each higher bit has half as many multiples, and the last one a single one."""

BELOW = (1, 2)
"""Distances below a multiple of the codes that are counted.  Chosen: a wrong weight of a bit by
up to 2 codes widens or skips these; with (1, 2, 3, 4) errors to 4 codes are described, with more
noise."""

# A mean over one period, with half a weight at both ends: exact for any pattern of that period.
_BOX = np.concatenate([[0.5], np.ones(PERIOD - 1), [0.5]]) / PERIOD
SMOOTH = 2 * np.pad(_BOX, PERIOD // 2) - np.convolve(_BOX, _BOX)
"""Weights of neighbouring codes from which the expected count of a code follows.  Derived: a mean
over one period removes any pattern of period 64, and twice it less its square (convolution) leaves
a parabola unchanged."""

CLEAR = 6.4
"""Distance [widths of the victim's spots] from an amplifier's own spots, and from its edges, beyond
which crosstalk is measured.  Chosen: half a pixel nearer, where the far side of a spot may be,
Gaussian spots of 1.1 pixel or more have fallen below 1e-7 of their peak, also those beyond an edge,
which are in another amplifier; with 12.8, spots of 1.1 pixel that are 28 pixels apart or nearer leave
no pixel between them."""

SIDE = 9
"""Half side [pixel] of the square in which a spot is the brightest pixel, and in which its light is
summed.  Chosen: four widths of spots of 2.2 pixel; with 18, spots 28 pixels apart are taken for one."""

HALO_ERROR = 5e-6
"""Crosstalk that unequal sides of spots' halos may imitate, added to the errors.  Chosen, to be
derived from halos: it is 0.2 ADU of 40,000; with 1e-5, crosstalk below 1e-5 could not be found."""


SIGNS = 16
"""Number of random patterns of signs from which the effect of the mean bias's noise is estimated.
Chosen: its variance is then known to 35 % for one pair of amplifiers; with 32, to 25 %."""


PILE = 16
"""Range of codes [ADU] within which full pixels lie.  Chosen: wider than read noise of a few
ADU; with 32 a pile must hold twice as many pixels to be recognised."""


def _piled(counts: NDArray[np.int64], width: float) -> bool:
    """Whether pixels pile up at one level, as where part of them are at full well.

    The counts in some 16 codes must be twice a Gaussian's at its middle, and 6 sigma above that.
    """
    most = float(np.convolve(counts, np.ones(PILE), "valid").max(initial=0.0))
    expected = float(counts.sum()) * PILE / (np.sqrt(2 * np.pi) * width)
    return most > 2 * expected + 6 * np.sqrt(expected)


TAIL = 2.75
"""Distance from the middle of a flat's codes [sigma] beyond which its two tails are compared.
Chosen: 0.3 % of the pixels lie in each, so that full wells up to 2.75 sigma above the mean are
recognised; with 5.5 hardly any pixel does."""


PATCH = 16
"""Side of the parts of a flat [pixel] within which its tails are compared.  Chosen: light that falls by
a tenth over 256 pixels falls by 0.6 % over 16, as much as counting of 30,000 electrons scatters; with
32, by twice that."""


BRIGHT = 0.5
"""Fraction of a flat's parts that are fainter than those whose tails are compared.  Chosen: full pixels
are in the brightest; with 0.75 half as many pixels are compared, and of 256 x 128 too few."""


def _cut_off(image: NDArray[np.float32], good: NDArray[np.bool_]) -> bool:
    """Whether the upper tail is missing beside the lower one, as where its pixels are full.

    With a mean two or three sigma below full well too few pixels pile up for :func:`_piled`, but
    codes near them have wrong frequencies.  The upper tail must hold less than half of the lower
    one, at 6 sigma, in the whole and within its brightest parts: where a stop darkens the corners, the
    lower tail of the whole is the longer one.
    """
    if not _lacks_high(image[good] - np.median(image[good])):
        return False
    ny, nx = (n // PATCH * PATCH for n in image.shape)
    parts = np.where(good, image, np.nan)[:ny, :nx].reshape(
        ny // PATCH, PATCH, nx // PATCH, PATCH
    )
    number = np.maximum(np.isfinite(parts).sum((1, 3)), 1)
    means = np.nansum(parts, (1, 3), dtype=np.float64) / number
    # Full pixels are where the light is brightest.
    bright = means >= np.quantile(means, BRIGHT) if means.size else np.zeros((0, 0), bool)
    away = (parts - means[:, None, :, None]).transpose(0, 2, 1, 3)[bright].ravel()
    away = away[np.isfinite(away)]
    return not away.size or _lacks_high(away - float(np.median(away)))


def _lacks_high(away: NDArray[np.floating[Any]]) -> bool:
    """Whether deviations from the middle have less than half as many high ones as low ones."""
    width = TAIL * 1.4826 * float(np.median(np.abs(away)))
    low, high = int((away < -width).sum()), int((away > width).sum())
    return high < 0.5 * low and low - high > 6 * np.sqrt(low + high)


class CodeChannels:
    """Histogram of codes of flats that are wide enough to visit all remainders equally often.

    A Gaussian of width s visits the remainders of P alike to 2 exp(-2 pi^2 s^2 / P^2): with
    s = 1.25 P to 1e-13.

    Parameters
    ----------
    fold : str
        Fold of the channel.
    """

    def __init__(self, fold: str = "fit") -> None:
        self._fold = fold
        self._counts: dict[int, NDArray[np.int64]] = {}
        self._piled: dict[int, int] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on flats that were left out; empty if none was."""
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
            good = np.isfinite(frame.image) & ~recoded_of(frame)
            codes = frame.image[good]
            middle = np.median(codes)
            width = 1.4826 * np.median(np.abs(codes - middle))
            if width < 1.25 * PERIOD:
                continue
            # Struck pixels are not distributed like the flat's; a converter has no codes below 0.
            inside = codes[np.abs(codes - middle) < 6 * width].astype(np.int64)
            counts = np.bincount(inside[inside >= 0])
            if _piled(counts, width) or _cut_off(frame.image, good):
                self._piled[amp] = self._piled.get(amp, 0) + 1
                continue
            kept = self._counts.get(amp, np.zeros(0, np.int64))
            size = -(-max(len(kept), len(counts)) // PERIOD) * PERIOD
            total = np.zeros(size, np.int64)
            total[: len(kept)] += kept
            total[: len(counts)] += counts
            self._counts[amp] = total

    def channels(self) -> list[Channel]:
        """Channel 'code_hist': relative excess of each remainder, and of codes below high bits."""
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
                # One is added, as nothing may be expected where a flat hardly reaches.
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
    """For each of :data:`BITS` that codes reach: counts below its multiples, expected, share."""
    multiple = np.arange(PERIOD, len(codes), PERIOD)
    # The highest power of two in each, by its lowest bit.
    bit = np.log2(multiple & -multiple).astype(int)
    smooth = np.maximum(np.convolve(codes, SMOOTH, "same"), 0.0)
    out = {}
    for b in BITS:
        own = multiple[bit == b]
        if not len(own):
            continue
        low, mean = (np.array([h[own - k].sum() for k in BELOW]) for h in (codes, smooth))
        share = float(smooth[own].sum() / max(smooth[multiple].sum(), 1e-9))
        out[b] = low, mean, share
    return out


class CrosstalkChannels:
    """Crosstalk of spots: signal in an amplifier in proportion to another's, read at the same time.

    Parameters
    ----------
    fold : str
        Fold of the channel.
    biases : int
        Number of biases whose mean is subtracted from all images; 0 if none is.
    """

    def __init__(self, fold: str = "fit", *, biases: int = 0) -> None:
        self._fold, self._biases = fold, biases
        self._sums: dict[tuple[int, int], FloatArray] = {}

    def add(self, images: Sequence[FloatArray], noise: Sequence[float]) -> None:
        """Add an exposure of spots.

        Parameters
        ----------
        images : sequence of ndarray, shape (ny, nx)
            Image of each amplifier in readout order, bias subtracted [ADU].
        noise : sequence of float
            Read noise of each amplifier [ADU].
        """
        levels = [float(np.nanmedian(i)) for i in images]
        signals = [
            np.nan_to_num(i - level) for i, level in zip(images, levels, strict=True)
        ]
        centres = [_spots(s, 100 * n) for s, n in zip(signals, noise, strict=True)]
        trees = [cKDTree(c) if len(c) else None for c in centres]
        widths = [_width(s, c) for s, c in zip(signals, centres, strict=True)]
        for a, aggressor in enumerate(signals):
            threshold = max(0.2 * float(np.percentile(aggressor, 99.9)), 100 * noise[a])
            rows, columns = np.nonzero(aggressor > threshold)
            for b, victim in enumerate(signals):
                tree, clear = trees[b], CLEAR * widths[b]
                if tree is None or a == b or not clear:
                    continue
                if len(rows) < 20 or len(centres[b]) < 4:
                    continue
                # A spot's halo is alike on both sides: the point across the victim's own spot
                # has the same halo and, mostly, no light in the other amplifier.
                distance, which = tree.query(np.column_stack([rows, columns]))
                y, x = (2 * centres[b][which] - np.column_stack([rows, columns])).T
                # Far from its spot that point may lie on another one of the victim.
                across, _ = tree.query(np.column_stack([y, x]))
                use = (
                    (np.minimum(distance, across) > clear)
                    & _is_inside(rows, columns, victim.shape, clear)
                    & _is_inside(y, x, victim.shape, clear)
                )
                aside = columns - centres[b][which][:, 1]
                r, c, y, x, aside = rows[use], columns[use], y[use], x[use], aside[use]
                dark = aggressor[y, x] < 0.01 * aggressor[r, c]
                r, c, y, x, aside = r[dark], c[dark], y[dark], x[dark], aside[dark]
                s = aggressor[r, c]
                rest = victim[r, c] - victim[y, x]
                good = np.abs(rest) < 6 * np.sqrt(2.0) * noise[b] + 0.01 * s
                s, rest = _without_trails(aside[good], s[good], rest[good])
                places = (v[good] for v in (r, c, y, x))
                signs = noise[b] * _by_signs(s, *places)
                sums = np.array([s @ rest, s @ s, *signs]) / (2 * noise[b] ** 2)
                self._sums[a, b] = self._sums.get((a, b), 0.0) + sums

    def channels(self) -> list[Channel]:
        """Channel 'amp_cross': fraction of the signal of ``amp`` that is seen in ``other``."""
        pairs = sorted(p for p, sums in self._sums.items() if sums[1] > 0)
        if not pairs:
            return []
        axes = Axes()
        nothing = Condition()
        up, down, *signs = np.array([self._sums[p] for p in pairs]).T
        # Spots are in the same places in all exposures, where the mean bias has the same noise.
        same = np.mean(np.square(signs), axis=0) / max(self._biases, 1) * (self._biases > 0)
        axes.add(len(pairs), nothing, amp=[p[0] for p in pairs], other=[p[1] for p in pairs],
                 what="crosstalk")  # fmt: skip
        variances = (1.0 + same / down) / down + HALO_ERROR**2
        blocks = tuple(variances[:, None, None])
        return [Channel("amp_cross", up / down, blocks, axes.columns(), "", self._fold)]


def _is_inside(
    y: NDArray[np.int64], x: NDArray[np.int64], shape: tuple[int, ...], clear: float
) -> NDArray[np.bool_]:
    """Mask of pixels that are at least ``clear`` from an image's edges [pixel]."""
    ny, nx = shape
    return (y >= clear) & (y < ny - clear) & (x >= clear) & (x < nx - clear)


def _by_signs(
    s: FloatArray,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    row_across: NDArray[np.int64],
    column_across: NDArray[np.int64],
) -> FloatArray:
    """Sums of s times random signs of pixels less those of pixels across, shape (SIGNS,).

    A pixel has the same signs in all exposures: the mean square of the sums over exposures is the
    variance that noise of variance 1 makes where it is the same in all.
    """
    here, across = (
        _hashed(y << 32 | x) for y, x in ((row, column), (row_across, column_across))
    )
    bits = np.arange(SIGNS, dtype=np.uint64)
    signs = [2.0 * ((h[:, None] >> bits) & np.uint64(1)) - 1.0 for h in (here, across)]
    return np.asarray(s @ (signs[0] - signs[1]))


def _hashed(key: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Numbers of 64 random bits, the same for the same key (Steele et al. 2014, SplitMix64)."""
    z = key.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))


def _without_trails(
    aside: NDArray[np.int64], s: FloatArray, rest: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The light s and what is seen of it, both less their means at each distance in x.

    Charge that the serial register defers behind the victim's own spots depends on the distance
    from them in x, not on the light in the other amplifier; the means remove it.
    """
    _, group = np.unique(aside, return_inverse=True)
    group = group.ravel()
    count = np.maximum(np.bincount(group), 1)
    s, rest = (v - (np.bincount(group, v) / count)[group] for v in (s, rest))
    return s, rest


def _spots(signal: FloatArray, threshold: float) -> NDArray[np.int64]:
    """Rows and columns of the peaks of spots, shape (n, 2)."""
    return np.column_stack(find_peaks(signal, threshold, SIDE))


def _width(signal: FloatArray, centres: NDArray[np.int64]) -> float:
    """Median width of spots [pixel], from second moments of their light; 0 without whole spots."""
    away = np.arange(-SIDE, SIDE + 1.0)
    found = []
    for y, x in centres:
        cut = signal[max(y - SIDE, 0) : y + SIDE + 1, max(x - SIDE, 0) : x + SIDE + 1]
        if cut.shape == (len(away), len(away)):
            sums = np.stack([cut.sum(0), cut.sum(1)])
            first, second = sums @ away / sums.sum(1), sums @ away**2 / sums.sum(1)
            # A pixel's side adds 1/12 to the variance.
            found.append(float((second - first**2).mean()) - 1 / 12)
    return float(np.sqrt(max(np.median(found), 0.0))) if found else 0.0
