"""Channels of biases and darks: noise covariance in readout order, bias levels, rows, dark current."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import Axes, ExposureInfo, Frame, condition_of
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

UNEVEN = 1.25
"""Robust scatter of a dark's columns over that expected from noise, above which their own
scatter is taken for their error.  Chosen, to be derived: the scatter by median deviations of n
columns is known to 1.17 / n^(1/2), so that 1.25 is 2.4 sigma for 128 columns (reached by noise
in 0.8 % of amplifiers) and 4.8 for 512; with 1.5, columns uneven by as much as noise would be
findings."""

HOT = 10.0
"""Excess of a column of an image of spots, beyond one sigma of the noise of a pixel, above which it
is hot [sigma of a column's mean].  Chosen: spots raise a column's median by half a sigma of a
pixel; with 20, hot columns of 64 pixels must be 1.6 times as bright to be removed."""

STANDS_OUT = 5.0
"""Significance [sigma] above which a covariance of the noise, or an excess of rows or columns,
enters the errors.  Chosen: noise exceeds 5 at one in 2e6 lags; with 10 weaker correlations are
left out of the errors, which are then too small."""

ROWS = 3
"""Number of rows between which the covariance of the noise is measured, too.  Chosen: levels of rows
that keep half of the row before are told from independent ones by the first; with 6, slower ones by
a half more."""

FRAME_ERROR = 0.1
"""Scatter of the bias level from frame to frame that is no finding [ADU].  Chosen, to be derived
from quiet systems: with 0.2, scatter of the level below 0.2 ADU could hardly be found."""

LEVEL_ERROR = 0.05
"""Systematic difference between the overscan's level and the image's that is no finding [ADU].
Chosen, to be derived from quiet systems: with 0.1, differences below 0.1 ADU could hardly be
found."""


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
        self._names: list[str] = []
        self.frames = 0
        self._spectra: list[list[FloatArray]] = []
        self._cross: list[FloatArray] = []
        self._rows: list[list[tuple[float, float, float]]] = []
        self._levels: list[tuple[ExposureInfo, list[tuple[float, float]]]] = []
        self._long: list[list[FloatArray]] = []
        self._zeros: list[list[tuple[float, float]]] = []
        self._size = 0
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
            self._sum[frame.name] += frame.pixels.astype(np.float64) - zero
        self.frames += 1
        here = [(f.pixels, zero) for f, zero in zip(frames, zeros, strict=True)]
        if not self._last:
            self._last = here
            return
        # Each frame is used in one difference only, so that the differences are independent.
        self._size = here[0][0].size
        flat = np.empty((len(here), self._size))
        spectra, long, rows = [], [], []
        for own, (a, zero_a), (b, zero_b) in zip(flat, self._last, here, strict=True):
            first, second = a.astype(np.float64) - zero_a, b.astype(np.float64) - zero_b
            noise = _without_outliers((first - second) / np.sqrt(2.0))
            own[:] = noise.ravel()
            long.append(_autocovariance(noise))
            self._lags = _lags(*noise.shape)
            spectra.append(long[-1][self._lags])
            rows.append(_row_excess(noise))
        self._last = []
        self._spectra.append(spectra)
        self._long.append(long)
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
            zeros.append(float(over.mean()) if over.size else 0.0)
            image = frame.image.astype(np.float64)
            if over.size:
                # Tracks of particles would raise the level by their number.
                struck = _struck(image, TRACK)
                image = image[~(struck & ~lit[n]) if lit else ~struck]
                share = image.var() / image.size + over.var() / over.size
                levels.append((float(image.mean()) - zeros[-1], share + LEVEL_ERROR**2))
        if len(levels) == len(frames):
            self._levels.append((exposure, levels))
            overs = [f.serial_overscan.astype(np.float64) for f in frames]
            self._zeros.append([(o.mean(), o.var() / o.size) for o in overs])
        return zeros

    def mean(self, name: str) -> FloatArray | None:
        """Mean bias of an amplifier's whole frame less its overscan level [ADU]; None without."""
        total = self._sum.get(name)
        return None if total is None else total / self.frames

    def forget_mean(self) -> None:
        """Release the sums that :meth:`mean` divides, which are as large as the sensor."""
        self._sum.clear()

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
        for amp, seen in enumerate(found):
            mean = np.mean([s[amp] for s in self._spectra], axis=0)
            values.append(mean)
            blocks.append(_errors_in_order(seen, self._lags) / (self._size * pairs))
            axes.add(len(mean), self._condition, amp=amp, lag=self._lags)
        out = [
            Channel("bias_cov", np.concatenate(values), tuple(blocks), axes.columns(), "adu2",
                    self._fold)
        ]  # fmt: skip
        out.append(self._bias_levels())
        if len(self._names) > 1:
            out.append(self._shared(found, pairs))
        return out

    def _seen(self, amp: int) -> FloatArray:
        """Covariances of the noise at all lags, those below STANDS_OUT set to zero [ADU^2]."""
        c = np.mean([s[amp] for s in self._long], axis=0)
        error = c[0] / np.sqrt(self._size * len(self._long))
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
                     what="rows", white=white)  # fmt: skip
        for exposure, levels in self._levels:
            level, variance = np.array(levels).T
            values.append(level)
            blocks.append(np.diag(variance))
            axes.add(len(level), self._condition, amp=np.arange(len(level)),
                     exposure=exposure.number, what="level", white=variance)  # fmt: skip
        if len(self._zeros) > 2:
            zeros = np.array(self._zeros)
            freedom = len(zeros) - 1
            white = zeros[..., 1].mean(0) + FRAME_ERROR**2
            scatter = zeros[..., 0].var(0, ddof=1) + FRAME_ERROR**2
            values.append(np.log(scatter / white))
            blocks.append(2.0 / freedom * np.eye(len(white)))
            axes.add(len(white), self._condition, amp=np.arange(len(white)), exposure=-1,
                     what="frames", white=white)  # fmt: skip
        return Channel("bias_level", np.concatenate(values), tuple(blocks), axes.columns(), "adu",
                       self._fold)  # fmt: skip

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


class DarkChannels:
    """Accumulates darks one by one: level by time and order, columns, struck pixels.

    Parameters
    ----------
    bias : mapping of str to ndarray
        Mean bias of each amplifier's image less its overscan [ADU]; may lack some.
    read_noise : mapping of str to float
        Read noise of each amplifier [ADU]; may lack some.
    fold : str
        Fold of the channel.
    biases : int
        Number of frames in the mean bias; 0 without one.
    """

    def __init__(
        self,
        bias: dict[str, FloatArray],
        read_noise: dict[str, float],
        fold: str = "fit",
        *,
        biases: int = 0,
    ) -> None:
        self._bias, self._noise, self._fold = bias, read_noise, fold
        self._biases = biases
        self._rows: list[
            tuple[ExposureInfo, float, list[tuple[float, float, int, int]]]
        ] = []
        self._columns: list[_Columns] = []
        self._names: list[str] = []
        self._condition = Condition()

    def add(
        self, exposure: ExposureInfo, frames: Sequence[Frame], *, after: float = 0.0
    ) -> None:
        """Add a dark; ``after`` is the mean level [ADU] of the exposure before it."""
        self._condition = condition_of(exposure)
        found = []
        lines = _Columns(exposure.exposure_time or 0.0, [], [], [])
        self._names = [f.name for f in frames]
        for frame in frames:
            over = frame.serial_overscan
            zero = float(over[:, over.shape[1] // 2 :].mean()) if over.size else 0.0
            image = frame.image.astype(np.float64) - zero
            bias = self._bias.get(frame.name)
            if bias is not None:
                image = image - bias
            sigma = self._noise.get(frame.name) or 1.4826 * float(
                np.median(np.abs(image - np.median(image)))
            )
            struck = np.abs(image - np.median(image)) > OUTLIER * sigma
            good = image[~struck]
            error = good.var() / good.size
            if over.size:
                error += float(over.var()) / (over.size // 2)
            found.append((float(good.mean()), float(error), int(struck.sum()), image.size))
            # A column most of whose pixels deviate is hot, not struck: it keeps its values.
            hot = struck.mean(0) > 0.5
            kept = np.where(struck & ~hot, np.nan, image)
            lines.means.append(np.nanmean(kept, 0))
            lines.own.append(np.nanvar(kept, 0) / image.shape[0])
            lines.noise.append(float(good.var()) / image.shape[0])
        self._rows.append((exposure, after, found))
        self._columns.append(lines)

    def channels(self) -> list[Channel]:
        """Channel 'dark_map': levels and struck pixels by dark, columns of the longest darks."""
        if not self._rows:
            return []
        values, blocks, axes = [], [], Axes()
        for exposure, after, found in self._rows:
            level, variance, struck, _ = (
                np.array(c, float) for c in zip(*found, strict=True)
            )
            amps = np.arange(len(level))
            common = {"amp": amps, "time": exposure.exposure_time or 0.0,
                      "exposure": exposure.number, "after": after}  # fmt: skip
            values.append(level)
            blocks.append(np.diag(variance))
            axes.add(len(level), self._condition, what="level", x=-1, **common)
            # Poisson; one is added to the variance, as zero may be counted where a few are expected.
            values.append(struck)
            blocks.append(np.diag(struck + 1.0))
            axes.add(len(level), self._condition, what="struck", x=-1, **common)
        longest = max(c.seconds for c in self._columns)
        chosen = [c for c in self._columns if c.seconds == longest]
        for amp in range(len(self._names)):
            mean = np.mean([c.means[amp] for c in chosen], axis=0)
            noise = float(np.mean([c.noise[amp] for c in chosen]))
            own = np.mean([c.own[amp] for c in chosen], axis=0)
            usual = self._column_error(mean, amp, noise, len(chosen)) ** 2
            # Dark current of a hot column has shot noise of its own.
            sure = STANDS_OUT * np.sqrt(2.0 / self._rows_of(amp, mean) / len(chosen))
            more = np.where(own > noise * (1 + sure), own - noise, 0.0) / len(chosen)
            values.append(mean - np.median(mean))
            blocks.extend((usual + more)[:, None, None])
            axes.add(len(mean), self._condition, what="column", x=np.arange(len(mean)), amp=amp,
                     time=longest, exposure=-1, after=0.0)  # fmt: skip
        return [Channel("dark_map", np.concatenate(values), tuple(blocks), axes.columns(), "adu",
                        self._fold)]  # fmt: skip

    def _column_error(self, mean: FloatArray, amp: int, noise: float, darks: int) -> float:
        """Error of a column's mean [ADU]: from the pixels' noise, or from the columns' own scatter.

        The scatter of a hundred columns is itself known to 10 % only, so that errors from it would
        scatter more than those from noise; it is used only where it exceeds noise by UNEVEN.

        Parameters
        ----------
        mean : ndarray, shape (columns,)
            Means of the columns [ADU].
        amp : int
            Index of the amplifier.
        noise : float
            Variance of a column's mean in one dark, with the share of the mean bias [ADU^2].
        darks : int
            Number of darks in the mean.
        """
        scatter = max(1.4826 * float(np.median(np.abs(mean - np.median(mean)))), 1e-6)
        read = self._noise.get(self._names[amp], 0.0)
        pixels = self._rows_of(amp, mean)
        # The mean bias is the same in all darks: its noise does not average out.
        shared = read**2 / self._biases / pixels if self._biases else 0.0
        expected = float(np.sqrt(max(noise - shared, 0.0) / darks + shared))
        return expected if scatter < UNEVEN * expected else scatter

    def _rows_of(self, amp: int, mean: FloatArray) -> float:
        """Number of pixels of a column."""
        return self._rows[0][2][amp][3] / len(mean)


class _Columns(NamedTuple):
    """Columns of one dark, by amplifier."""

    seconds: float
    means: list[FloatArray]
    own: list[FloatArray]
    """Variance of each column's mean from its own pixels [ADU^2]."""
    noise: list[float]
    """Variance of a column's mean from all pixels [ADU^2]."""


def without_hot_columns(image: FloatArray, noise: float) -> FloatArray:
    """Image of spots [ADU] with hot columns set to the level of the others.

    A column's median separates its level from spots on it: a row of spots raises the median by
    half a standard deviation of the noise only.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Image of one amplifier, bias subtracted [ADU].
    noise : float
        Read noise of a pixel [ADU].

    Returns
    -------
    image : ndarray, shape (ny, nx)
        The same array where no column is hot.
    """
    columns = np.nanmedian(image, axis=0)
    excess = columns - np.nanmedian(columns)
    hot = excess > noise * (1.0 + HOT / np.sqrt(image.shape[0]))
    return image - np.where(hot, excess, 0.0) if hot.any() else image


def _without_outliers(noise: FloatArray) -> FloatArray:
    """Noise less its median, struck pixels set to 0."""
    return np.where(_struck(noise), 0.0, noise - np.median(noise))


def _struck(noise: FloatArray, limit: float = OUTLIER) -> NDArray[np.bool_]:
    """Pixels beyond ``limit`` robust standard deviations, which are taken as 0.3 ADU at least.

    The bound is about the uniform error of rounding, 12^(-1/2) ADU, so that noise below one step
    of the converter, whose median deviation is 0, has no struck pixels.
    """
    away = np.abs(noise - np.median(noise))
    return np.asarray(away > limit * max(1.4826 * float(np.median(away)), 0.3))


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
    share = noise.var() / columns
    excess = float(noise.mean(1).var(ddof=1) / share - 1.0)
    noise = noise - noise.mean()
    lags = near_lags(columns)
    near = sum((noise[:, k:] * noise[:, :-k]).sum() / rows / columns for k in lags.tolist())
    excess -= 2 * float(near) / float(noise.var())
    # All products of two pixels of a row have the same variance, and no covariance.
    far = 2.0 / (rows - 1) - 4.0 / rows / columns * float((1 - lags / columns).sum())
    return excess, float(np.sqrt(far)), float(share)
