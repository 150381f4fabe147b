"""Channel 'dark_map' of darks: level, struck pixels, columns; hot columns in images of spots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.bias_channels import OUTLIER, STANDS_OUT, TRACK
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import (
    Axes,
    ExposureInfo,
    Frame,
    condition_of,
    overscan_level,
    zero_pixels,
)
from bfsensor.typing import FloatArray

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
    tails : sequence of sequence of int
        Pixels of each bias and amplifier in the tails of the noise, from :func:`count_tails`; as
        many are expected in a dark, without any particle.
    """

    def __init__(
        self,
        bias: dict[str, FloatArray],
        read_noise: dict[str, float],
        fold: str = "fit",
        *,
        biases: int = 0,
        tails: Sequence[Sequence[int]] = (),
    ) -> None:
        self._bias, self._noise, self._fold = bias, read_noise, fold
        self._biases = biases
        self._tails = np.array(tails, float)
        self._rows: list[
            tuple[ExposureInfo, float, list[tuple[float, float, int, int, int]]]
        ] = []
        self._columns: list[_Columns] = []
        self._names: list[str] = []
        self._condition = Condition()
        self._unzeroed = False

    def add(
        self, exposure: ExposureInfo, frames: Sequence[Frame], *, after: float = 0.0
    ) -> None:
        """Add a dark; ``after`` is the mean level [ADU] of the exposure before it."""
        self._condition = condition_of(exposure)
        found = []
        lines = _Columns(exposure.exposure_time or 0.0, [], [], [])
        self._names = [f.name for f in frames]
        for frame in frames:
            over = zero_pixels(frame)
            self._unzeroed |= not over.size
            image = frame.image.astype(np.float64) - overscan_level(frame)
            bias = self._bias.get(frame.name)
            if bias is not None:
                image = image - bias
            # Dark current that is alike in neighbours strikes none, whatever its shot noise.
            scatter = 1.4826 / np.sqrt(2.0) * float(np.median(np.abs(np.diff(image))))
            sigma = max(self._noise.get(frame.name) or 0.0, scatter)
            struck = np.abs(image - np.median(image)) > OUTLIER * sigma
            good = image[~struck]
            error = good.var() / good.size
            if over.size:
                error += float(over.var()) / over.size
            # Particles stand out of their own column, whose level may be any.  A hot column, whose
            # shot noise is larger than others', keeps its values.
            hot = struck.mean(0) > 0.5
            out = (np.abs(image - np.median(image, axis=0)) > OUTLIER * sigma) & ~hot
            groups = np.bincount(label(out, np.ones((3, 3)))[0].ravel())[1:]
            squares = int((groups**2).sum())
            found.append(
                (float(good.mean()), float(error), int(out.sum()), squares, image.size)
            )
            kept = np.where(out, np.nan, image)
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
        expected, scatter = self._usual_tails()
        drift = self._drift() if self._unzeroed else 0.0
        for exposure, after, found in self._rows:
            level, variance, struck, squares, _ = (
                np.array(c, float) for c in zip(*found, strict=True)
            )
            amps = np.arange(len(level))
            common = {"amp": amps, "time": exposure.exposure_time or 0.0,
                      "exposure": exposure.number, "after": after}  # fmt: skip
            values.append(level)
            blocks.append(np.diag(variance) + drift)
            axes.add(len(level), self._condition, what="level", x=-1, **common)
            # Tracks are Poisson, not their pixels: each counts with the square of its size.  One is
            # added to the variance, as zero may be counted where a few are expected.
            values.append(struck - expected)
            blocks.append(np.diag(np.maximum(squares - expected, 0.0) + 1.0 + scatter))
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

    @property
    def notes(self) -> list[str]:
        """Sentences that say what these darks do not show."""
        times = {row[0].exposure_time or 0.0 for row in self._rows}
        if not self._unzeroed or len(times) != 1 or self._fold != "fit":
            return []
        return [
            f"darks have no overscan and one exposure time ({times.pop():g} s): their mean level counts "
            "as drift of the bias, so that dark current which is the same in all pixels is not seen; "
            "take darks of two exposure times"
        ]

    def _drift(self) -> FloatArray:
        """Covariance of the zeros of a dark without overscan, by amplifier [ADU^2].

        The bias level drifts between a dark and the biases, by as much as darks differ from a dark
        current: by the offset of a straight line over the exposure time, and by the scatter about it.
        """
        time = np.array([row[0].exposure_time or 0.0 for row in self._rows])
        level = np.array([[amp[0] for amp in row[2]] for row in self._rows])
        if len(np.unique(time)) < 2 or len(time) < 3:
            return np.asarray(level.T @ level / len(level))
        design = np.column_stack([np.ones(len(time)), time])
        line = np.linalg.lstsq(design, level, rcond=None)[0]
        left = level - design @ line
        return np.asarray(np.outer(line[0], line[0]) + left.T @ left / (len(time) - 2))

    def _usual_tails(self) -> tuple[FloatArray, FloatArray]:
        """Pixels in the tails of the noise of a frame by amplifier, and the variance of that number.

        Pulses of several pixels make it scatter by more than a Poisson number.
        """
        if not len(self._tails):
            return (np.zeros(len(self._names)),) * 2
        n = len(self._tails)
        mean = self._tails.mean(0)
        scatter = self._tails.var(0, ddof=1) if n > 1 else mean
        return mean, np.maximum(mean, scatter) * (1 + 1 / n)

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
        return self._rows[0][2][amp][4] / len(mean)


def count_tails(
    frames: Sequence[Frame],
    bias: dict[str, FloatArray],
    read_noise: dict[str, float],
    biases: int,
) -> list[int]:
    """Count the pixels of a bias that lie in the tails of the noise, by amplifier.

    They are as far out as struck pixels of darks, but not as far as most of a particle's.

    Parameters
    ----------
    frames : sequence of Frame
        One of the biases that the mean bias is made of.
    bias, read_noise, biases
        As for :class:`DarkChannels`; two biases at least.

    Returns
    -------
    counts : list of int
    """
    out = []
    for frame in frames:
        sigma, mean = read_noise.get(frame.name, 0.0), bias.get(frame.name)
        if mean is None or not sigma > 0 or biases < 2:
            out.append(0)
            continue
        away = np.abs(frame.image - overscan_level(frame) - mean)
        # A frame is part of its mean bias; a dark is not.
        scale = sigma * np.sqrt((1 - 1 / biases) / (1 + 1 / biases))
        out.append(int(((away > OUTLIER * scale) & (away < TRACK * scale)).sum()))
    return out


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
    # numpy's nanmedian takes each column in turn, twenty times slower.
    median = np.median if np.isfinite(image).all() else np.nanmedian
    columns = median(image, axis=0)
    excess = columns - np.nanmedian(columns)
    hot = excess > noise * (1.0 + HOT / np.sqrt(image.shape[0]))
    return image - np.where(hot, excess, 0.0) if hot.any() else image
