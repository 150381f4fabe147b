"""Channels of flats: covariances of pairs, means against the lamp monitor, overscan profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import binary_dilation, median_filter
from scipy.stats import chi2

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.cosmetics import with_defects
from bfsensor.diagnose.data.exposure_info import (
    NUMBERS,
    REPEATS,
    Axes,
    ExposureInfo,
    Frame,
    condition_of,
    overscan_level,
    zero_pixels,
)
from bfsensor.diagnose.data.lamp_settings import lamp_settings, smoothed_levels
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.typing import FloatArray

LAGS = 4
"""Largest lag of the covariances of flats [pixel].  Chosen: 25 lags hold most of the effect;
with 8, 81 lags are measured, those beyond 4 mostly noise, and errors take ten times the memory."""

TAIL = 8
"""Number of last pixels of an overscan that define the zero of its profile.  Chosen: charge
deferred by more pixels is taken for zero level; with 16, overscans up to 16 pixels deep have no
profile."""

CHANCE = 0.01
"""Probability by the assumed noise of the scatter between exposures, of overscan profiles or of repeated
levels, below which that scatter is their error.  Chosen: in one of a hundred campaigns it is, although
noise is as assumed; with 0.02, in two."""

LAMP_UNKNOWN = 0.02
"""Relative error of the light of an exposure without a lamp monitor, where too few levels are repeated
to show it.  Chosen, to be derived from shutters and lamps: deviations from linearity below 2 % are then
no findings; with 0.04, those below 4 %."""

ALONG = 12
"""Number of lines of an overscan over which its noise is correlated.  Chosen: pulses of 6 pixels on
average have 89 % of their correlation there; with 24 it is known 1.4 times less well."""

STRUCK = 10.0
"""Departure of a pixel of a flat from its partner, or in a single flat from the median of its 5 x 5
neighbours, over the median of all pixels' departures, above which a particle struck it and it is left
out of means and maps: 6.7 standard deviations.  Chosen:
noise reaches it in 2e-11 of pixels; with 20, a particle's pixels may shift the mean of 1e4 pixels by
1e-4 of their noise."""


@dataclass
class _FlatGroup:
    """Measurements of the pairs of one condition, level, amplifier and fold."""

    covariances: list[FloatArray] = field(default_factory=list)
    counts: list[NDArray[np.int64]] = field(default_factory=list)
    levels: list[float] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    hours: list[float] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    serial: list[FloatArray] = field(default_factory=list)
    parallel: list[FloatArray] = field(default_factory=list)
    clipped: int = 0


@dataclass
class OverscanZero:
    """Profiles of the overscans of an amplifier's biases, one for each frame."""

    serial: list[FloatArray] = field(default_factory=list)
    parallel: list[FloatArray] = field(default_factory=list)

    def add(self, frame: Frame) -> None:
        """Add a bias."""
        self.serial.append(profile(frame.serial_overscan, 1))
        self.parallel.append(profile(frame.parallel_overscan, 0))


class FlatChannels:
    """Accumulates pairs of flats one by one and gives their channels.

    Parameters
    ----------
    bias : mapping of str to ndarray
        Mean bias of each amplifier's image less its overscan [ADU]; may lack some.
    read_noise : mapping of str to float
        Read noise of each amplifier [ADU]; may lack some.
    lamp_error : float
        Relative error of the lamp monitor.
    lags : int
        Largest lag of the covariances [pixel].
    start : float
        Time of the first exposure of the campaign [MJD]; nan where not known.
    steps : mapping of int to float, optional
        Level of each flat by its number, from
        :func:`bfsensor.diagnose.data.flat_pairing.find_steps`; by default its exposure time.
    zeros : mapping of str to sequence of OverscanZero, optional
        By fold, the overscans of biases in each amplifier: their mean profile, which no light
        causes, is subtracted from that of flats.
    pulses : ndarray, optional
        Covariance by lag of pulses of the amplifiers' noise, from
        :meth:`bfsensor.diagnose.data.bias_channels.BiasChannels.pulses`.

    Attributes
    ----------
    zero_drift : ndarray or None
        Covariance of the zeros of flats without overscan by amplifier [ADU^2], from
        :attr:`bfsensor.diagnose.data.dark_channels.DarkChannels.zero_drift`.
    """

    def __init__(
        self,
        bias: dict[str, FloatArray],
        read_noise: dict[str, float],
        *,
        lamp_error: float,
        lags: int = LAGS,
        start: float = np.nan,
        steps: Mapping[int, float] | None = None,
        zeros: Mapping[str, Sequence[OverscanZero]] | None = None,
        pulses: FloatArray | None = None,
    ) -> None:
        self._pulses = np.zeros(1) if pulses is None else pulses
        self._bias, self._noise, self._start = bias, read_noise, start
        self.zero_drift: FloatArray | None = None
        self._zeros = zeros or {}
        self._steps = steps or {}
        self._lamp_error, self._lags = lamp_error, lags
        self._lamps: dict[int, tuple[int, float]] = {}
        self._groups: dict[tuple, _FlatGroup] = {}
        self._means: dict[str, list[tuple]] = {}
        self._ratios: dict[int, list[tuple[float, float]]] = {}
        self._lines: dict[tuple[str, int], _Lines] = {}

    def add_pair(
        self,
        first: tuple[ExposureInfo, Sequence[Frame]],
        second: tuple[ExposureInfo, Sequence[Frame]],
        *,
        fold: str,
    ) -> None:
        """Measure one pair of flats of equal exposure and add it to its group.

        Parameters
        ----------
        first, second : (ExposureInfo, sequence of Frame)
            The two flats, with the frames of all amplifiers.
        fold : str
            'fit', 'select' or 'held-out'.

        Raises
        ------
        MeasurementError
            Covariances cannot be measured.
        """
        condition = condition_of(first[0])
        step = self._step(first[0])
        means: list[list[tuple[float, float, bool, int]]] = [[], []]
        for n, frames in enumerate(zip(first[1], second[1], strict=True)):
            name = frames[0].name
            images = [self.clean(f) for f in frames]
            mask = frames[0].mask | frames[1].mask
            found = flat_covariances(
                *images, mask=mask, lags=self._lags, unit="adu", region=name
            )
            group = self._groups.setdefault((condition, step, n, fold), _FlatGroup())
            group.covariances.append(found.covariances)
            group.counts.append(found.pairs)
            group.levels.append(found.level)
            group.hours += [self._hours(e) for e, _ in (first, second)]
            group.times += [e.exposure_time or 0.0 for e, _ in (first, second)]
            group.numbers += [e.number for e, _ in (first, second)]
            group.clipped += found.clipped
            for frame in frames:
                group.serial.append(profile(frame.serial_overscan, 1))
                group.parallel.append(profile(frame.parallel_overscan, 0))
                for where, lines in (
                    ("serial", frame.serial_overscan), ("parallel", frame.parallel_overscan.T)
                ):  # fmt: skip
                    self._lines.setdefault((where, n), _Lines()).add(lines)
            for k in (0, 1):
                m, count = self._whole_mean(frames[k], found.means[k], found.pixels)
                read = self._noise.get(name, 0.0) ** 2
                means[k].append((m, *self._zero_error(frames[k], count), count))
                self._ratios.setdefault(n, []).append(
                    (m, (found.covariances[0, 0] - read) / m)
                )
        for (exposure, _), values in zip((first, second), means, strict=True):
            self._means.setdefault(fold, []).append((exposure, condition, values))

    def add_single(
        self, exposure: ExposureInfo, frames: Sequence[Frame], *, fold: str
    ) -> None:
        """Measure the mean of a flat without a partner.

        Parameters
        ----------
        exposure : ExposureInfo
            The flat.
        frames : sequence of Frame
            Frames of all amplifiers.
        fold : str
            'fit', 'select' or 'held-out'.
        """
        values = []
        for frame in frames:
            image = self.clean(frame)
            good = ~frame.mask & np.isfinite(image)
            # A pair's difference shows struck pixels; here the surroundings of each pixel do.
            away = image - median_filter(np.where(good, image, np.nanmedian(image)), 5)
            usual = float(np.median(np.abs(away[good]))) if good.any() else 0.0
            good &= np.abs(away) <= STRUCK * max(usual, 1e-300)
            m = float(image[good].mean()) if good.any() else 0.0
            m, count = self._whole_mean(frame, m, max(int(good.sum()), 1))
            values.append((m, *self._zero_error(frame, count), count))
        if all(m > 0 for m, *_ in values):
            self._means.setdefault(fold, []).append(
                (exposure, condition_of(exposure), values)
            )

    def _step(self, exposure: ExposureInfo) -> float:
        return self._steps.get(exposure.number, exposure.exposure_time or 0.0)

    def clean(self, frame: Frame) -> FloatArray:
        """Image less the frame's overscan level and the mean bias [ADU]."""
        return self._less_bias(frame, frame.image.astype(np.float64))

    def _less_bias(self, frame: Frame, image: FloatArray) -> FloatArray:
        bias = self._bias.get(frame.name)
        image = image - overscan_level(frame)
        return image if bias is None else image - bias

    def _whole_mean(self, frame: Frame, mean: float, count: int) -> tuple[float, int]:
        """Mean of a flat with its defects' recorded values [ADU], and the number of its pixels.

        ``mean`` is that of the ``count`` pixels without defects.
        """
        image, others = with_defects(frame)
        if not others.any():
            return mean, count
        # Particles stand out of the pixels above and below; beside them, response differs.
        away = (image - median_filter(image, (5, 1)))[others]
        struck = away > STRUCK * max(float(np.median(np.abs(away))), 1e-300)
        values = self._less_bias(frame, image)[others][~struck]
        total = count + len(values)
        return float(mean * count + values.sum()) / total, total

    def _zero_error(self, frame: Frame, count: int) -> tuple[float, bool]:
        """Variance by read noise of the mean of ``count`` pixels [ADU^2]; whether it has an overscan.

        With one, the noise of the overscan's mean is part of the variance.
        """
        read, size = self._noise.get(frame.name, 0.0) ** 2, zero_pixels(frame).size
        return read / count + (read / size if size else 0.0), size > 0

    def _hours(self, exposure: ExposureInfo) -> float:
        """Time since the first exposure of the campaign [h]; nan where not known."""
        return np.nan if exposure.mjd is None else 24.0 * (exposure.mjd - self._start)

    def channels(self) -> list[Channel]:
        """Channels 'flat_cov', 'flat_mean' and overscans of all pairs, by fold."""
        self._set_lamps()
        return [*self._covariances(), *self._mean_levels(), *self._overscans()]

    def _set_lamps(self) -> None:
        """Find the lamp's setting, and its light, in exposures without a monitor."""
        taken: dict[Condition, list[tuple[int, float, float]]] = {}
        for exposure, condition, amplifiers in chain(*self._means.values()):
            if exposure.lamp is not None:
                self._lamps[exposure.number] = 0, exposure.lamp
            elif exposure.exposure_time:
                level = float(np.mean([m for m, *_ in amplifiers]))
                taken.setdefault(condition, []).append(
                    (exposure.number, exposure.exposure_time, level)
                )
        for rows in taken.values():
            numbers, seconds, levels = zip(*rows, strict=True)
            settings, light = lamp_settings(seconds, levels)
            for number, setting, lamp in zip(numbers, settings, light, strict=True):
                self._lamps[number] = int(setting), float(lamp)

    def _covariances(self) -> list[Channel]:
        out = []
        j, i = (index.ravel() for index in np.indices((self._lags + 1,) * 2))
        for fold in dict.fromkeys(key[3] for key in self._groups):
            values, blocks, axes = [], [], Axes()
            for (condition, step, amp, which), group in self._groups.items():
                if which != fold:
                    continue
                pairs = np.sum(group.counts, axis=0)
                mean = np.average(group.covariances, axis=0, weights=group.counts)
                values.append(mean.ravel())
                blocks.append(bartlett_matrix(mean, pairs))
                level = float(np.mean(group.levels))
                axes.add(
                    len(j), condition, amp=amp, time=_mean_time(group), step=step, level=level,
                    lamp=float(np.mean([self._lamps.get(n, (0, 1.0))[1] for n in group.numbers])),
                    pairs=len(group.levels), hours=float(np.mean(group.hours)), i=i, j=j,
                    pulse=self._pulse(i, j),
                )  # fmt: skip
            out.append(
                Channel("flat_cov", np.concatenate(values), tuple(blocks), axes.columns(),
                        "adu2", fold)
            )  # fmt: skip
        return out

    def _pulse(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> FloatArray:
        """Covariance of pulses of the noise at lags, in units of that at lag (1, 0); 0 without."""
        shape = self._pulses
        inside = (j == 0) & (i > 0) & (i < len(shape))
        return np.where(inside, shape[np.minimum(i, len(shape) - 1)], 0.0)

    def _mean_levels(self) -> list[Channel]:
        out: list[Channel] = []
        if not self._ratios:
            # Without a pair no gain is known.
            return out
        unknown = self._light_scatter()
        for fold, rows in self._means.items():
            values, blocks, axes = [], [], Axes()
            for exposure, condition, amplifiers in rows:
                m, zero, zeroed, pixels = np.array(amplifiers, float).T
                # The brighter-fatter effect moves charge between pixels but conserves it: the sum
                # of many has Poisson noise, although a pixel's variance is less.
                variance = m * [self._poisson(n) for n in range(len(m))] / pixels + zero
                setting, lamp = self._lamps.get(exposure.number, (0, 1.0))
                error = unknown if exposure.lamp is None else self._lamp_error
                values.append(m)
                # Without darks that show a drift, a zero is taken to be known as one pixel is.
                lacking = 1.0 - zeroed
                drift = (
                    np.diag(zero * pixels) if self.zero_drift is None else self.zero_drift
                )
                drift = drift * np.outer(lacking, lacking)
                blocks.append(np.diag(variance) + error**2 * np.outer(m, m) + drift)
                axes.add(
                    len(m), condition, amp=np.arange(len(m)), time=exposure.exposure_time,
                    zeroed=zeroed > 0 if self.zero_drift is not None else True,
                    step=self._step(exposure),
                    lamp=lamp, setting=setting,
                    monitored=exposure.lamp is not None, exposure=exposure.number, level=m,
                    mjd=np.nan if exposure.mjd is None else exposure.mjd,
                    hours=self._hours(exposure),
                )  # fmt: skip
            columns = axes.columns()
            light = columns["time"] * columns["lamp"]
            same = [columns[n] for n in (*NUMBERS, "amp", "setting")]
            columns["level"] = smoothed_levels(columns["level"], light, same)
            out.append(
                Channel(
                    "flat_mean", np.concatenate(values), tuple(blocks), columns, "adu", fold
                )
            )
        return out

    def _light_scatter(self) -> float:
        """Relative scatter of the light of exposures without a lamp monitor.

        Levels that were repeated over more than half of the series of flats show flicker and drift
        of the lamp.  Without enough of these it is :data:`LAMP_UNKNOWN`, or the scatter of all repeated
        levels where noise of that size makes it with a probability below :data:`CHANCE`.
        """
        every = [r for rows in self._means.values() for r in rows if r[0].lamp is None]
        numbers = [e.number for e, *_ in every]
        groups: dict[tuple, list[tuple[int, float]]] = {}
        for exposure, condition, amplifiers in every:
            if seconds := exposure.exposure_time:
                light = float(np.mean([m for m, *_ in amplifiers])) / seconds
                setting, _ = self._lamps.get(exposure.number, (0, 1.0))
                key = condition, self._step(exposure), setting
                groups.setdefault(key, []).append((exposure.number, light))
        long, short = np.zeros(2), np.zeros(2)
        for members in groups.values():
            at, light_of = np.array(members).T
            scatter = np.array(
                [np.square(light_of / light_of.mean() - 1).sum(), len(at) - 1]
            )
            short += scatter
            if np.ptp(at) > 0.5 * np.ptp(numbers):
                long += scatter
        if long[1] >= REPEATS:
            return float(np.sqrt(long[0] / long[1]))
        refuted = chi2.sf(short[0] / LAMP_UNKNOWN**2, short[1]) < CHANCE
        return float(np.sqrt(short[0] / short[1])) if refuted else LAMP_UNKNOWN

    def _poisson(self, amp: int) -> float:
        """Variance of a pixel over its mean in the faintest 30 % of flats [ADU], the inverse gain."""
        level, ratio = np.array(self._ratios[amp]).T
        weak = level <= np.quantile(level, 0.3)
        return float(max(np.median(ratio[weak]), 0.0))

    def _overscans(self) -> list[Channel]:
        out = []
        for word, name in (
            ("serial_overscan", "serial"),
            ("parallel_overscan", "parallel"),
        ):
            uneven = self._unevenness(name)
            for fold in dict.fromkeys(key[3] for key in self._groups):
                values: list[FloatArray] = []
                blocks: list[FloatArray] = []
                axes = Axes()
                for amp in range(len(uneven)):
                    own = []
                    for (condition, step, n, which), group in self._groups.items():
                        profiles = [p for p in getattr(group, name) if len(p)]
                        if which != fold or n != amp or not profiles:
                            continue
                        mean, matrix = mean_profile(
                            np.array(profiles), self._lines[name, amp].correlation
                        )
                        own.append(uneven[amp] * matrix)
                        zero = self._zero(fold, amp, name, len(mean))
                        values.append(mean if zero is None else mean - zero[0])
                        axes.add(
                            len(mean), condition, amp=amp, time=_mean_time(group), step=step,
                            level=float(np.mean(group.levels)), k=np.arange(1, len(mean) + 1),
                        )  # fmt: skip
                    if own:
                        # The biases' mean has the same error in the profiles of all levels.
                        zero = self._zero(fold, amp, name, len(own[0]))
                        blocks += (
                            own
                            if zero is None
                            else [
                                block_diag(*own)
                                + np.tile(uneven[amp] * zero[1], (len(own),) * 2)
                            ]
                        )
                if values:
                    out.append(
                        Channel(word, np.concatenate(values), tuple(blocks), axes.columns(),
                                "adu", fold)
                    )  # fmt: skip
        return out

    def _zero(
        self, fold: str, amp: int, name: str, size: int
    ) -> tuple[FloatArray, FloatArray] | None:
        """Mean profile of the biases' overscans and its covariance; None without biases."""
        every = self._zeros.get(fold, ())
        profiles = [p for p in getattr(every[amp], name) if len(p)] if every else []
        if not profiles:
            return None
        tied = self._lines[name, amp].correlation
        if profiles[0].shape[0] != len(tied):
            return None
        mean, matrix = mean_profile(np.array(profiles), tied)
        return (mean, matrix) if len(mean) == size else None

    def _unevenness(self, name: str) -> dict[int, float]:
        """Variance of profiles over that of white noise, by amplifier.

        Pulses of the noise are several pixels long; where profiles scatter more than that between
        exposures, as where rows fluctuate together, that scatter counts.
        """
        seen: dict[int, list[tuple[float, int]]] = {}
        for (_, _, amp, _), group in self._groups.items():
            profiles = [p for p in getattr(group, name) if len(p)]
            if len(profiles) > 1:
                tied = self._lines[name, amp].correlation
                seen.setdefault(amp, []).append(_scatter(np.array(profiles), tied))
        out = {amp: 1.0 for _, _, amp, _ in self._groups}
        if self._pulses.any():
            out |= {
                n: lines.length for (word, n), lines in self._lines.items() if word == name
            }
        every = {amp: np.sum(both, axis=0) / (out[amp], 1) for amp, both in seen.items()}
        if every and chi2.sf(*np.sum(list(every.values()), axis=0)) < CHANCE:
            out |= {
                amp: out[amp] * max(float(total / n), 1.0)
                for amp, (total, n) in every.items()
            }
        return out


def _mean_time(group: _FlatGroup) -> float:
    """Mean exposure time [s]; that of each flat to the last bit where all are equal."""
    return group.times[0] + float(np.mean(np.array(group.times) - group.times[0]))


class _Lines:
    """Accumulates the covariance of the pixels of an overscan: along its depth, and between lines."""

    def __init__(self) -> None:
        self._sum: FloatArray | float = 0.0
        self._beside = np.zeros(ALONG + 1)
        self._count = 0

    def add(self, strip: NDArray[np.float32]) -> None:
        """Add an overscan, shape (lines, depth)."""
        if strip.size:
            away = strip - strip.mean(0)
            # Tracks of particles are no noise.
            usual = 1.4826 * float(np.median(np.abs(away)))
            away = np.where(np.abs(away) > STRUCK * max(usual, 0.3), 0.0, away)
            self._sum = self._sum + away.T @ away
            self._count = len(away)
            for k in range(min(ALONG + 1, len(away))):
                self._beside[k] += float((away[: len(away) - k] * away[k:]).sum())

    @property
    def length(self) -> float:
        """Variance of a mean over all lines in units of that by white noise.

        Pulses of the noise are several pixels long, which are neighbouring lines of an overscan.
        """
        n, products = self._count, self._beside
        if n <= 4 * ALONG or not products[0] > 0:
            return 1.0
        seen = 1.0 + 2.0 * float(products[1:].sum() / products[0])
        # Lines less the mean of all n are anticorrelated by 1 / (n - 1) where noise is white.
        pairs = 2.0 * float((1.0 - np.arange(1, ALONG + 1) / n).sum())
        return seen / (1.0 - (1.0 + pairs - seen) / n)

    @property
    def correlation(self) -> FloatArray:
        """Correlation of the noise of two pixels along the depth; shape (depth, depth)."""
        if isinstance(self._sum, float):
            return np.zeros((0, 0))
        size = np.sqrt(np.maximum(np.diag(self._sum), 1e-30))
        out = self._sum / np.outer(size, size)
        np.fill_diagonal(out, 1.0)
        return np.asarray(out)


def _above_tail(depth: int) -> FloatArray:
    """Matrix that takes a profile to its values above the mean of its tail."""
    head = depth - TAIL
    return np.hstack([np.eye(head), np.full((head, TAIL), -1.0 / TAIL)])


def _scatter(profiles: FloatArray, correlation: FloatArray) -> tuple[float, int]:
    """Chi-square of profiles above their tails about their mean, and its degrees of freedom."""
    values, variance = profiles[..., 0], profiles[..., 1]
    head = values.shape[1] - TAIL
    step = _above_tail(values.shape[1])
    above = values @ step.T
    size = np.sqrt(variance.mean(0))
    error = np.diag(step @ (correlation * np.outer(size, size)) @ step.T)
    square = (above - above.mean(0)) ** 2 / error
    return float(square.sum()), (len(profiles) - 1) * head


def profile(strip: NDArray[np.float32], axis: int) -> FloatArray:
    """Profile of an overscan along its depth: mean, and variance of the mean.

    Parameters
    ----------
    strip : ndarray, shape (ny, nx)
        Overscan [ADU].
    axis : int
        Axis along which charge is deferred: 1 for a serial overscan, 0 for a parallel one.

    Returns
    -------
    profile : ndarray, shape (n, 2)
        Mean [ADU] and its variance [ADU^2]; n = 0 with :data:`TAIL` pixels or fewer in depth, or
        fewer than 8 lines.
    """
    depth = strip.shape[axis] if strip.ndim == 2 else 0
    lines = strip.size // depth if depth else 0
    if depth <= TAIL or lines < 8:
        return np.zeros((0, 2))
    other = 1 - axis
    values = strip.astype(np.float64)
    return np.stack([values.mean(other), values.var(other, ddof=1) / lines], axis=1)


def mean_profile(
    profiles: FloatArray, correlation: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Mean profile above its own tail, and the covariance of its errors.

    Parameters
    ----------
    profiles : ndarray, shape (exposures, n, 2)
        Profiles from :func:`profile`, n above :data:`TAIL`.
    correlation : ndarray, shape (n, n), optional
        Correlation of the noise of two pixels along the depth; by default it is independent.

    Returns
    -------
    values : ndarray, shape (n - 8,)
        Mean above the mean of the last 8 pixels [ADU].
    covariance : ndarray, shape (n - 8, n - 8)
        All values share the error of the tail [ADU^2].
    """
    count = len(profiles)
    mean = profiles[..., 0].mean(0)
    variance = profiles[..., 1].mean(0) / count
    head = len(mean) - TAIL
    values = mean[:head] - mean[head:].mean()
    tied = np.eye(len(mean)) if correlation is None else correlation
    step, size = _above_tail(len(mean)), np.sqrt(variance)
    return values, step @ (tied * np.outer(size, size)) @ step.T


def leave_out_struck(first: FloatArray, second: FloatArray) -> None:
    """Set pixels that a particle struck in either flat of a pair, and those beside them, to nan there.

    Without this, a track of 600 e- per pixel along a column of dim flats is a column of their map.
    A particle adds charge; where boundaries between pixels are displaced in one flat, as beside a
    tear that the other has not, a pixel has what another one nearby lacks, and both stay.

    Parameters
    ----------
    first, second : ndarray, shape (ny, nx)
        An amplifier's image in the two flats [ADU], changed in place; nan is ignored.
    """
    apart = first / np.nanmean(first) - second / np.nanmean(second)
    # One pixel of 16 knows the usual departure to 1 % in amplifiers of 512 x 512 pixels.
    usual = float(np.nanmedian(np.abs(apart[::4, ::4])))
    above, below = apart > STRUCK * usual, apart < -STRUCK * usual
    for image, more, less in ((first, above, below), (second, below, above)):
        if usual and more.any():
            struck = more & ~binary_dilation(less, np.ones((5, 5)))
            image[binary_dilation(struck, np.ones((3, 3)))] = np.nan
