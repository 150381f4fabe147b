"""Channels of biases: noise covariance in readout order, bias levels, rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import chi2, norm

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import (
    Axes,
    ExposureInfo,
    Frame,
    condition_of,
    overscan_level,
)
from bfsensor.effects.read_noise import READOUT_LAGS, near_lags
from bfsensor.typing import FloatArray

OUTLIER = 6.0
"""Deviation of a pixel of a bias or dark [sigma, at least 0.3 ADU] above which it counts as struck
by a particle.  Chosen: Gaussian noise exceeds 6 once in 5e8 pixels; with 12, pixels of 6 to 12
sigma would stay in the noise and not be counted."""

TRACK = 20.0
"""Deviation of a pixel of a bias [sigma] above which it has no part in the bias level.  Chosen:
above the charge that spots leave behind, so that persistence stays in the level; with 40 tracks
of 20 to 40 sigma are in it, too."""

SCATTERED = 3.0
"""Significance [sigma] above which noise is not Gaussian: by the scatter of autocovariances between
strips of frames, which then replaces Bartlett's errors, and by third cumulants, which are then
pulses.  Chosen: Gaussian noise exceeds 3 at one in 700 lags, whose errors are then 1.2 times as
large; with 6, errors of pulses' lags may be 1.6 times too small, and pulses as high as the noise
are taken for Gaussian noise."""

STANDS_OUT = 5.0
"""Significance [sigma] above which a covariance of the noise, or an excess of rows or columns,
enters the errors.  Chosen: noise exceeds 5 at one in 2e6 lags; with 10 weaker correlations are
left out of the errors, which are then too small."""

ROWS = 3
"""Number of rows between which the covariance of the noise is measured, too.  Chosen: levels of rows
that keep half of the row before differ from independent ones by the first; with 6, slower ones by a
half more."""

FRAME_ERROR = 0.1
"""Scatter of an amplifier's bias level, against the others', that is no finding [ADU].  Chosen, to be
derived from quiet systems: with 0.2, scatter of the level below 0.2 ADU could hardly be found."""

JUMP = 1.0
"""The same of a single amplifier, whose drift with the bench has no other to be compared with [ADU].
Published: bias jumps of LSST sensors are typically above 1 ADU (SITCOMTN-148, Rubin Observatory
2024)."""

ROW_ERROR = 0.05
"""Scatter of the levels of an amplifier's rows that is no finding [ADU].  The fit holds the variance of
these levels to 0, with the square of this as its error.  Chosen, to be derived from quiet systems: with
0.1, levels that scatter by 0.2 ADU would be found at 4 sigma at most, with 0.05 at 16."""

TOGETHER = 0.9
"""Part of the variance of the amplifiers' bias levels that one common drift has, above which it gives
their relative sensitivities.  Chosen: two amplifiers that jump independently reach it in none of a
thousand series of eight frames; with 0.95, drifts of 4 times the read noise of the levels are needed."""

PARTS = 16
"""Number of strips of rows of a bias whose autocovariances scatter.  Chosen: with four pairs of
biases the scatter gives an error to 9 %; with 64, strips of 256 rows are shorter than waves that
keep their phase over several rows."""


class BiasChannels:
    """Accumulates bias frames one by one; gives their channels, the mean bias and the read noise.

    Parameters
    ----------
    fold : str
        Fold of the channels.

    Attributes
    ----------
    frames : int
        Number of frames in the mean bias.
    """

    def __init__(self, fold: str = "fit") -> None:
        self._fold = fold
        self._last: list[tuple[NDArray[np.float32], float]] = []
        self._sum: dict[str, FloatArray] = {}
        self._far: dict[str, list[tuple[NDArray[np.int64], FloatArray]]] = {}
        self._names: list[str] = []
        self.frames = 0
        self._spectra: list[list[FloatArray]] = []
        self._cross: list[FloatArray] = []
        self._rows: list[list[tuple[float, float, float]]] = []
        self._levels: list[tuple[ExposureInfo, list[tuple[float, float]]]] = []
        self._long: list[FloatArray] = []
        self._zeros: list[tuple[int, list[tuple[float, float]]]] = []
        self._third: list[FloatArray] = []
        self._strips: list[list[FloatArray]] = []
        self._size, self._width = 0, 1
        self._lags = np.arange(READOUT_LAGS + 1)
        self._condition = Condition()

    def add(self, exposure: ExposureInfo, frames: Sequence[Frame]) -> None:
        """Add a bias frame."""
        self._condition = condition_of(exposure)
        self._names = [f.name for f in frames]
        zeros = self.add_level(exposure, frames)
        for frame, zero in zip(frames, zeros, strict=True):
            if frame.name not in self._sum:
                self._sum[frame.name] = np.zeros(frame.pixels.shape)
            above = frame.pixels.astype(np.float64) - zero
            self._sum[frame.name] += above
            far = np.flatnonzero(_struck(above, TRACK))
            self._far.setdefault(frame.name, []).append((far, above.flat[far]))
        self.frames += 1
        here = [(f.pixels, zero) for f, zero in zip(frames, zeros, strict=True)]
        if not self._last:
            self._last = here
            return
        # Each frame is used in one difference only, so that the differences are independent.
        self._size, self._width = here[0][0].size, here[0][0].shape[1]
        flat = np.empty((len(here), self._size))
        spectra, long, rows, strips = [], [], [], []
        for own, (a, zero_a), (b, zero_b) in zip(flat, self._last, here, strict=True):
            first, second = a.astype(np.float64) - zero_a, b.astype(np.float64) - zero_b
            noise = _without_outliers((first - second) / np.sqrt(2.0))
            own[:] = noise.ravel()
            long.append(_autocovariance(noise))
            self._lags = _lags(*noise.shape)
            spectra.append(long[-1][self._lags])
            rows.append(_row_excess(noise))
            strips.append(_scatter_of_strips(noise))
        self._last = []
        self._strips.append(strips)
        self._spectra.append(spectra)
        # As long as a quarter of a frame: summed, as many pairs of large frames would not fit.
        if self._long:
            long = [a + b for a, b in zip(self._long, long, strict=True)]
        self._long = long
        self._rows.append(rows)
        flat -= flat.mean(1, keepdims=True)
        self._cross.append(flat @ flat.T / (self._size - (len(flat) > 1)))

    def add_level(
        self,
        exposure: ExposureInfo,
        frames: Sequence[Frame],
        lit: Sequence[NDArray[np.bool_]] = (),
    ) -> list[float]:
        """Add a bias frame to the levels alone; returns each amplifier's overscan level [ADU].

        Charge in pixels that were ``lit`` before is persistence and stays in the level, however
        far out it is.
        """
        zeros, levels = [], []
        for n, frame in enumerate(frames):
            over = frame.serial_overscan.astype(np.float64)
            # Without an overscan the mean bias is the zero of flats: its level stays in it.
            zeros.append(overscan_level(frame))
            image = frame.image.astype(np.float64)
            if over.size:
                # Tracks of particles would raise the level by their number.
                struck = _struck(image, TRACK)
                out = struck & ~lit[n] if lit else struck
                rows = np.where(out, np.nan, image)
                # The scatter of rows has all noise that is correlated along them.
                above = np.nanmean(rows, axis=1) - over.mean(axis=1)
                share = float(above.var(ddof=1)) / len(above)
                levels.append((float(np.nanmean(rows)) - float(over.mean()), share))
        if len(levels) == len(frames):
            self._levels.append((exposure, levels))
            overs = [f.serial_overscan.astype(np.float64) for f in frames]
            self._zeros.append((exposure.number, [_mean_and_variance(o) for o in overs]))
        return zeros

    def mean(self, name: str) -> FloatArray | None:
        """Mean bias of an amplifier's whole frame less its overscan level [ADU]; None without.

        Pixels that are struck in up to half of the frames are left out there.
        """
        total = self._sum.get(name)
        if total is None:
            return None
        out = total / self.frames
        pixels, values = (
            np.concatenate(part) for part in zip(*self._far[name], strict=True)
        )
        often = np.bincount(pixels, minlength=out.size)
        struck = np.flatnonzero((often > 0) & (2 * often <= self.frames))
        excess = np.bincount(pixels, values, out.size)
        left = total.flat[struck] - excess[struck]
        out.flat[struck] = left / (self.frames - often[struck])
        return out

    def forget_mean(self) -> None:
        """Release the sums that :meth:`mean` divides, which are as large as the sensor."""
        self._sum.clear()
        self._far.clear()

    @property
    def read_noise(self) -> dict[str, float]:
        """Read noise of each amplifier by name [ADU]; empty with fewer than two frames."""
        if not self._spectra:
            return {}
        variance = np.mean([[s[0] for s in one] for one in self._spectra], axis=0)
        return {n: float(np.sqrt(v)) for n, v in zip(self._names, variance, strict=True)}

    def channels(self) -> list[Channel]:
        """Channels 'bias_cov', 'bias_level' and, with several amplifiers, 'amp_cross'."""
        if not self._spectra:
            return []
        pairs = len(self._spectra)
        values, blocks, axes = [], [], Axes()
        found = [self._seen(amp) for amp in range(len(self._names))]
        pulses, _ = self.pulses()
        for amp, seen in enumerate(found):
            mean = np.mean([s[amp] for s in self._spectra], axis=0)
            values.append(mean)
            blocks.append(self._errors(seen, amp) / (self._size * pairs))
            near = np.minimum(self._lags, READOUT_LAGS)
            pulse = np.where(self._lags <= READOUT_LAGS, pulses[near], 0.0)
            same = np.clip(1.0 - self._lags / self._width, 0.0, None)
            axes.add(len(mean), self._condition, amp=amp, lag=self._lags, pulse=pulse,
                     pairs=pairs, same_row=same)  # fmt: skip
        out = [
            Channel("bias_cov", np.concatenate(values), tuple(blocks), axes.columns(), "adu2",
                    self._fold)
        ]  # fmt: skip
        out.append(self._bias_levels())
        if len(self._names) > 1:
            out.append(self._shared(found, pairs))
        return out

    def add_third(self, frames: Sequence[Frame], bias: Mapping[str, FloatArray]) -> None:
        """Add third cumulants of a bias frame's noise about the mean bias, by lag and amplifier."""
        out = []
        for frame in frames:
            mean = bias.get(frame.name)
            if mean is None:
                continue
            d = _without_outliers(frame.image - overscan_level(frame) - mean).ravel()
            if not d.std() > 0:
                # One bias is its own mean: nothing is left of its noise.
                continue
            # A mean or a variance left in would be covariances at all lags.
            d = (d - d.mean()) / d.std()
            square, n = d**2 - 1.0, len(d)
            out.append(np.array([
                0.5 * (square[: n - h] @ d[h:] + square[h:] @ d[: n - h]) / (n - h)
                for h in range(1, READOUT_LAGS + 1)
            ]) * np.sqrt(2.0 * n / (d**4).mean()))  # fmt: skip
        if len(out) == len(frames):
            self._third.append(np.array(out))

    def drift(self) -> tuple[float, float]:
        """Range of the mean bias level of all amplifiers [ADU], and its deviate."""
        if len(self._zeros) < 2:
            return 0.0, 0.0
        zeros = np.array([z for _, z in self._zeros])
        size = float(np.ptp(zeros[..., 0].mean(1)))
        error = float(np.sqrt(zeros[..., 1].mean() / zeros.shape[1]))
        return size, size / max(error, 1e-12) / np.sqrt(2.0)

    def pulses(self) -> tuple[FloatArray, float]:
        """Covariance by lag of pulses in the amplifiers' noise, and the deviate of the pulses.

        The covariance at lag 1 is 1; all are 0 without pulses.

        A random telegraph signal of the output transistor has covariances that fall exponentially
        with the lag (Machlup 1954, J. Appl. Phys. 25, 341).  Unlike Gaussian noise, and unlike
        independent noise of any distribution, it has third cumulants between pixels that fall
        alike.  Where these are significant, one exponential is fitted to them and the covariances.
        Pulses as high as the noise have third cumulants 0.8 times as significant as their
        covariances, lower ones less in proportion to their height: with the limit of covariances
        they would be taken for Gaussian noise.
        """
        out = np.zeros(READOUT_LAGS + 1)
        if not self._third or not self._spectra:
            return out, 0.0
        shapes = np.exp(
            -np.arange(READOUT_LAGS) / np.geomspace(0.2, 4.0 * READOUT_LAGS, 200)[:, None]
        )
        shapes /= np.sqrt(np.square(shapes).sum(1))[:, None]
        each = np.array(self._third) @ shapes.T
        gain = len(each) * each.mean(0) ** 2
        # Third cumulants of correlated noise scatter by more than those of white noise.
        scatter = each.var(0, ddof=1) if len(each) > 1 else 1.0
        clear = (gain / np.maximum(scatter, 1.0)).sum(0).max()
        chance = max(float(chi2.sf(clear, each.shape[1])), np.finfo(float).tiny)
        deviate = float(norm.isf(chance))
        if deviate < SCATTERED:
            return out, deviate
        c = np.mean(self._spectra, axis=0)
        away = (
            c[:, 1 : READOUT_LAGS + 1] / c[:, :1] * np.sqrt(self._size * len(self._spectra))
        )
        best = shapes[int(np.argmax((gain + np.square(away @ shapes.T)).sum(0)))]
        out[1:] = best / best[0]
        return out, deviate

    def _errors(self, seen: FloatArray, amp: int) -> FloatArray:
        """Covariance of an amplifier's autocovariances, times the length of the series [ADU^4].

        Bartlett's formula is that of Gaussian noise.  Heavy tails and pulses scatter more: where
        strips of the frames do so significantly, their scatter scales the errors.
        """
        out = _errors_in_order(seen, self._lags)
        strips = np.mean([s[amp] for s in self._strips], axis=0) * self._size
        freedom = (PARTS - 1) * len(self._strips)
        ratio, more = strips / np.diag(out)[: len(strips)], np.ones(len(out))
        clear = ratio > 1 + SCATTERED * np.sqrt(2 / freedom)
        more[: len(strips)] = np.sqrt(np.where(clear, ratio, 1.0))
        return np.asarray(out * np.outer(more, more))

    def _seen(self, amp: int) -> FloatArray:
        """Covariances of the noise at all lags, those below STANDS_OUT set to zero [ADU^2]."""
        c = self._long[amp] / len(self._spectra)
        error = c[0] / np.sqrt(self._size * len(self._spectra))
        return np.where(np.abs(c) > STANDS_OUT * error, c, 0.0)

    def _bias_levels(self) -> Channel:
        """Excess variance of rows by pair, level above the overscan by frame, scatter of frames."""
        values, blocks, axes = [], [], Axes()
        excess = np.array([[e for e, *_ in one] for one in self._rows])
        # The error of a variance is in proportion to it: where an excess is certain, it counts.
        mean = excess.mean(0)
        least = STANDS_OUT * np.array([e for _, e, _ in self._rows[0]]) / len(excess) ** 0.5
        more = np.where(mean > least, 1 + mean, 1.0)
        # A periodic disturbance has another phase in each frame, the same in all its rows: the
        # excess scatters between pairs by more than rows would.  With one pair that scatter is
        # not known, and the excess is compared with noise alone.
        apart = excess.std(0, ddof=1) if len(excess) > 1 else np.zeros(len(mean))
        apart = np.where(np.abs(mean) > least, apart, 0.0)
        for n, one in enumerate(self._rows):
            value, error, white = np.array(one).T
            values.append(value)
            blocks.append(np.diag(np.maximum(more * error, apart) ** 2))
            axes.add(len(one), self._condition, amp=np.arange(len(one)), exposure=2 * n,
                     what="rows", white=white, same_row=self._share_of_far_lags() / white)  # fmt: skip
        for exposure, levels in self._levels:
            level, variance = np.array(levels).T
            values.append(level)
            blocks.append(np.diag(variance))
            axes.add(len(level), self._condition, amp=np.arange(len(level)),
                     exposure=exposure.number, what="level", white=variance,
                     same_row=0.0)  # fmt: skip
        if len(self._zeros) > 2:
            zeros = np.array([z for _, z in sorted(self._zeros)])
            own, amps = _contrasts(zeros[..., 0])
            white = zeros[..., 1].mean(0) @ own.T**2
            white += (FRAME_ERROR if len(own.T) > 1 else JUMP) ** 2
            # A slow drift hardly changes from one bias to the next; what jumps does.  Half of the
            # mean square of successive differences is the variance of independent values (von
            # Neumann 1941, Ann. Math. Stat. 12, 367), with the variance (3 n - 4) / (n - 1)^2.
            steps = np.diff(zeros[..., 0], axis=0) @ own.T
            floor = white - zeros[..., 1].mean(0) @ own.T**2
            values.append(np.log((0.5 * np.square(steps).mean(0) + floor) / white))
            n = len(zeros)
            blocks.append((3.0 * n - 4.0) / (n - 1.0) ** 2 * np.eye(len(white)))
            axes.add(len(white), self._condition, amp=amps, exposure=-1,
                     what="frames", white=white, same_row=0.0)  # fmt: skip
        amps = np.arange(len(self._names))
        values.append(np.zeros(len(amps)))
        blocks.append(ROW_ERROR**4 * np.eye(len(amps)))
        axes.add(len(amps), self._condition, amp=amps, exposure=-1, what="usual rows", white=1.0,
                 same_row=1.0)  # fmt: skip
        return Channel("bias_level", np.concatenate(values), tuple(blocks), axes.columns(), "adu",
                       self._fold)  # fmt: skip

    def _share_of_far_lags(self) -> float:
        """Variance of a row's mean, for rows of independent levels of unit variance, at far lags.

        Near lags are values of 'bias_cov'.
        """
        lag = np.arange(len(near_lags(self._width)) + 1.0, self._width)
        return 2.0 / self._width * float((1.0 - lag / self._width).sum())

    def _shared(self, found: list[FloatArray], pairs: int) -> Channel:
        """Covariance of the noise between amplifiers at the same readout time."""
        mean = np.mean(self._cross, axis=0)
        a, b = np.triu_indices(len(mean), 1)
        axes = Axes()
        axes.add(len(a), self._condition, amp=a, other=b, what="noise")
        n = self._size * pairs
        error = [
            (2 * found[i] @ found[j] - found[i][0] * found[j][0] + mean[i, j] ** 2) / n
            for i, j in zip(a, b, strict=True)
        ]
        return Channel("amp_cross", mean[a, b], tuple(np.array([[e]]) for e in error),
                       axes.columns(), "adu2", self._fold)  # fmt: skip


def _without_outliers(noise: FloatArray) -> FloatArray:
    """Noise less its median; struck pixels have the medians of their column and row."""
    noise = noise - np.median(noise)
    # A level of whole columns or rows, however far out, is noise of the amplifier.
    level = np.broadcast_to(np.median(noise, axis=0), noise.shape)
    level = level + np.median(noise - level, axis=1, keepdims=True)
    return np.where(_struck(noise - level), level, noise)


def _struck(noise: FloatArray, limit: float = OUTLIER) -> NDArray[np.bool_]:
    """Pixels beyond ``limit`` robust standard deviations, which are taken as 0.3 ADU at least.

    The bound is about the uniform error of rounding, 12^(-1/2) ADU, so that noise below one step
    of the converter, whose median deviation is 0, has no struck pixels.
    """
    away = np.abs(noise - np.median(noise))
    return np.asarray(away > limit * max(1.4826 * float(np.median(away)), 0.3))


def _contrasts(levels: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Contrasts of amplifiers' levels from levels of shape (frames, amplifiers); the amplifier of each.

    What moves all amplifiers together, such as the temperature of their common supply, is a drift of
    the bench; an amplifier that jumps by itself is unstable.  Each amplifier is compared with those
    before it (Helmert's contrasts), in proportion to what the drift moves them by where the levels
    show that.  A single amplifier is its own.
    """
    amplifiers = levels.shape[1]
    if amplifiers == 1:
        return np.ones((1, 1)), np.zeros(1, int)
    _, size, parts = np.linalg.svd(levels - levels.mean(0), full_matrices=False)
    drift = parts[0] * np.sign(parts[0].sum())
    if size[0] ** 2 < TOGETHER * (size**2).sum() or (drift <= 0).any():
        drift = np.ones(amplifiers)
    last = np.arange(1, amplifiers)
    own = np.eye(amplifiers)[1:]
    for k in last:
        before = drift[:k] / float(drift[:k] @ drift[:k])
        own[k - 1, :k] = -drift[k] * before
    return np.asarray(own / np.sqrt(np.square(own).sum(1))[:, None]), last


def _mean_and_variance(strip: FloatArray) -> tuple[float, float]:
    """Mean of an overscan, and its variance from the scatter of the means of rows."""
    rows = strip.mean(axis=1)
    return float(rows.mean()), float(rows.var(ddof=1)) / len(rows)


def _scatter_of_strips(noise: FloatArray) -> FloatArray:
    """Variance of the autocovariances of a frame by their scatter between strips of its rows."""
    strips = [s.ravel() - s.mean() for s in np.array_split(noise, PARTS)]
    found = [
        [s[: len(s) - h] @ s[h:] / (len(s) - h) for h in range(READOUT_LAGS + 1)]
        for s in strips
        if len(s) > READOUT_LAGS
    ]
    return np.asarray(np.var(found, axis=0, ddof=1) / len(found))


def _autocovariance(noise: FloatArray) -> FloatArray:
    """Autocovariance of pixels in readout order, at lags up to a quarter of the frame [ADU^2]."""
    series = noise.ravel() - noise.mean()
    n = len(series)
    size = next_fast_len(2 * n, real=True)
    lags = max(n // 4, min(n, READOUT_LAGS + 1))
    power = np.abs(rfft(series, size)) ** 2
    return np.asarray(irfft(power, size)[:lags] / (n - np.arange(lags)))


def _lags(rows: int, columns: int) -> NDArray[np.int64]:
    """Lags of the measured noise [pixel times]: those of near pixels, and of :data:`ROWS` rows.

    Noise of a long memory and levels of rows are alike within a row; between rows they are not.
    """
    near = np.arange(min(READOUT_LAGS, max(rows * columns - 1, 0)) + 1)
    far = columns * np.arange(1, ROWS + 1)
    # The measured autocovariance ends at a quarter of the frame.
    return np.concatenate([near, far[(far > near[-1]) & (far < rows * columns // 4)]])


def _errors_in_order(c: FloatArray, h: NDArray[np.int64]) -> FloatArray:
    """Covariance matrix of sample autocovariances at lags ``h``, times the series' length [ADU^4].

    Bartlett's formula, cov(c_h, c_k) = sum over m of (c_m c_(m+h-k) + c_m c_(m+h+k)) / n.  The
    sum over a quarter of the frame's lags holds nearly all of it even for a wave that keeps its
    phase through the frame.
    """
    n = len(c)
    size = next_fast_len(2 * n + 2 * int(h[-1]), real=True)
    even = np.zeros(size)
    even[:n] = c
    even[size - n + 1 :] = c[:0:-1]
    g = irfft(rfft(even).real ** 2, size)
    return np.asarray(g[np.abs(h[:, None] - h)] + g[h[:, None] + h])


def _row_excess(noise: FloatArray) -> tuple[float, float, float]:
    """Relative excess of the variance of rows' means over white noise; its error; that variance.

    Covariances of pixels a few lags apart are left out of the excess: they are values of
    'bias_cov', and would otherwise be counted twice.
    """
    rows, columns = noise.shape
    noise = noise - noise.mean()
    lags = near_lags(columns)
    near = sum((noise[:, k:] * noise[:, :-k]).sum(1) for k in lags.tolist()) / columns
    share = noise.var() / columns
    # The excess is a mean over rows: pulses of the noise, which few rows hold, scatter it.
    each = (np.square(noise.mean(1)) * rows / (rows - 1.0) / share) - 2 * near / noise.var()
    excess = float(each.mean()) - 1.0
    # All products of two pixels of a row have the same variance, and no covariance.
    far = 2.0 / (rows - 1) - 4.0 / rows / columns * float((1 - lags / columns).sum())
    own = float(each.var(ddof=1)) / rows
    more = own if own > far * (1 + SCATTERED * np.sqrt(2 / rows)) else far
    return excess, float(np.sqrt(more)), float(share)
