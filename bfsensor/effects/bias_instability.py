"""Bias instability: the bias level varies from frame to frame or from row to row.

A shape that all frames share is no instability: it is subtracted with the biases' mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Segment
from bfsensor.effects.random_covariances import scatter_of_pairs
from bfsensor.effects.read_noise import ReadNoise, added, near_lags
from bfsensor.typing import FloatArray

SOURCE = (
    "Bias jumps and shapes beyond the overscan's level, typically above 1 ADU, of LSST sensors: "
    "SITCOMTN-148 (Rubin Observatory 2024), bias stability; range assumed"
)


class BiasByFrame(Effect):
    """The bias level of each frame varies by ``rms``; subtracting the overscan removes it.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.3 to 10 (0 changes nothing).

    Examples
    --------
    >>> BiasByFrame({"rms": 2.0}).name
    'bias_instability:frame'
    """

    word = "bias_instability"
    variant = "frame"
    parameters = (Parameter("rms", "e-", 0.3, 10.0, amplitude=True),)
    touches = ("bias_level",)
    source = SOURCE

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        return added(frames, [self["rms"] * rng.standard_normal((1, 1)) for _ in frames])

    def bias_level(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.where(axes["what"] == "frames", self["rms"] ** 2, 0.0)


class BiasByRow(ReadNoise):
    """The bias level of each row varies by ``rms``, independently in each amplifier.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.3 to 3 (0 changes nothing).

    Examples
    --------
    >>> BiasByRow({"rms": 0.9}).name
    'bias_instability:row'
    """

    word = "bias_instability"
    variant = "row"
    parameters = (Parameter("rms", "e-", 0.3, 3.0, amplitude=True),)
    touches = ("bias_cov", "bias_level", "flat_cov")
    source = SOURCE

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        return added(
            frames, [self["rms"] * rng.standard_normal((len(f), 1)) for f in frames]
        )

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        # Fraction of the pixels of a row whose partner, `lag` pixels later, is in the same row.
        return np.asarray(self["rms"] ** 2 * np.clip(1 - np.abs(lag) / width, 0, None))

    def on_frame(self, i: NDArray, j: NDArray, width: float) -> FloatArray:
        return np.where(np.broadcast_arrays(i, j)[1] == 0, self["rms"] ** 2, 0.0)


class BiasByRowWithMemory(ReadNoise):
    """The bias level of each row varies by ``rms`` and remembers the part ``corr`` of the row before.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.3 to 3 (0 changes nothing); ``corr``: 0.05 to 0.99.

    Examples
    --------
    >>> BiasByRowWithMemory({"rms": 0.9, "corr": 0.7}).name
    'bias_instability:row_memory'
    """

    word = "bias_instability"
    variant = "row_memory"
    parameters = (
        Parameter("rms", "e-", 0.3, 3.0, amplitude=True),
        Parameter("corr", "", 0.05, 0.99, law="flat", ends=(0.0, 0.999)),
    )
    touches = ("bias_cov", "bias_level", "flat_cov")
    source = (
        "Bias levels by row that follow the overscan's: Plazas Malagon et al. 2024, arXiv 2404.14516; "
        "range assumed"
    )

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        keep, out = self["corr"], []
        for frame in frames:
            fresh = self["rms"] * rng.standard_normal(len(frame))
            fresh[1:] *= np.sqrt(1 - keep**2)
            out.append(lfilter([1.0], [1.0, -keep], fresh)[:, None])
        return added(frames, out)

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        rows, part = np.divmod(np.abs(lag) / np.asarray(width), 1.0)
        return np.asarray(self._rows(rows) * (1 - part) + self._rows(rows + 1) * part)

    def on_frame(self, i: NDArray, j: NDArray, width: float) -> FloatArray:
        return self._rows(np.abs(np.broadcast_arrays(i, j)[1]))

    def _rows(self, apart: NDArray) -> FloatArray:
        """Covariance of two rows [e-^2]."""
        keep = float(np.clip(self["corr"], 0.0, 0.999))
        return np.asarray(self["rms"] ** 2 * keep**apart)


class SettlingByFrame(ReadNoise):
    """Each row settles exponentially over ``length`` pixels, by ``rms`` that differs between frames.

    The settling of a frame is the same in all of its rows; that of the mean of all frames is 0.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 1 to 30 at the first column (0 changes nothing); ``length``
        [pixel]: 3 to 300.

    Examples
    --------
    >>> SettlingByFrame({"rms": 5.0, "length": 20.0}).name
    'bias_instability:settling'
    """

    word = "bias_instability"
    variant = "settling"
    parameters = (
        Parameter("rms", "e-", 1.0, 30.0, amplitude=True),
        Parameter("length", "pixel", 3.0, 300.0),
    )
    touches = ("bias_cov", "bias_level", "dark_map", "flat_cov", "flat_mean")
    scatters = ("bias_level", "dark_map", "flat_mean")
    response = "quadratic"
    source = (
        "Two-dimensional bias that differs between frames of LSST's camera: Utsumi et al. 2024, Proc. "
        "SPIE 13103; an exponential along rows, as of a clamp that settles; range assumed"
    )

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        return added(frames, [
            self["rms"] * rng.standard_normal() * self._shape(f.shape[1])[None] for f in frames
        ])  # fmt: skip

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        lag, width = np.broadcast_arrays(np.abs(np.asarray(lag)), np.asarray(width))
        out = np.zeros(lag.shape)
        # A reduced recording has frames of no width, and no order of readout.
        for size in np.unique(width[width > 0]):
            rows = width == size
            shape = self._shape(int(size)) - self._shape(int(size)).mean()
            spectrum = np.abs(np.fft.rfft(shape)) ** 2
            # Rows follow one another without a gap and are alike: the covariance is periodic.
            c = np.fft.irfft(spectrum, int(size)) / int(size)
            out[rows] = self["rms"] ** 2 * c[lag[rows].astype(int) % int(size)]
        return out

    def bias_level(self, axes: Axes, layout: Layout) -> FloatArray:
        # All rows of a frame are alike, so that their means do not vary: all covariances within a row
        # add up to 0, and those at far lags are minus the variance and the near ones, which the
        # measurement subtracts.
        out = np.zeros(len(axes["amp"]))
        widths = layout.frame_width(axes["amp"])
        for width in map(int, np.unique(widths)):
            shape = self._shape(width) - self._shape(width).mean()
            apart = np.correlate(shape, shape, "full")[width:] / width
            far = float(apart[len(near_lags(width)) :].sum())
            rows = (widths == width) & (axes["what"] == "rows")
            out[rows] = 2.0 / width * self["rms"] ** 2 * far
        return out

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        """Scatter of levels above the overscan's, frame by frame, and of columns of darks."""
        amps = np.asarray(axes["amp"]).astype(int)
        if word == "bias_cov":
            if "pairs" not in axes:
                return None
            # Each pair has one size, which all lags have in common.
            size = self.bias_cov(axes, layout) * np.sqrt(
                2.0 / np.asarray(axes["pairs"], float)
            )
            return np.where(amps[:, None] == np.unique(amps), size[:, None], 0.0)
        if word == "flat_cov":
            return scatter_of_pairs(self, axes, layout, lambda *_: np.sqrt(2.0))
        if word not in self.scatters:
            return None
        apart = np.array([
            self._mean(s.prescan, s.columns, s) - self._mean(s.prescan + s.columns, s.serial_overscan, s)
            for s in layout.segments
        ])  # fmt: skip
        frames = np.asarray(axes["exposure"])
        if word == "flat_mean":
            return np.asarray(self["rms"] * np.diag(apart[amps]))
        what = axes["what"]
        level = np.where(what == "level", apart[amps], 0.0)
        if word == "bias_level":
            return np.asarray(self["rms"] * np.diag(level)[:, level != 0])
        column = what == "column"
        for amp, s in enumerate(layout.segments):
            own = amps == amp
            shape = self._shape(s.prescan + s.columns)[s.prescan :]
            x = np.asarray(axes["x"])[own & column].astype(int)
            level[own & column] = (shape - np.median(shape))[x]
        long = np.asarray(axes["time"]) == np.max(axes["time"])
        parts = []
        for amp in np.unique(amps):
            darks = np.unique(frames[(amps == amp) & ~column & long])
            for frame in np.unique(frames[(amps == amp) & ~column]):
                rows = (amps == amp) & (frames == frame)
                # Columns are means of the longest darks, each of which has a part of its own in them.
                part = 1 / len(darks) if frame in darks else 0.0
                parts.append(
                    np.where(
                        rows, level, np.where((amps == amp) & column, part * level, 0.0)
                    )
                )
            if layout.biases:
                # All have the mean bias in common.
                size = level / np.sqrt(len(layout.biases))
                parts.append(np.where(amps == amp, size, 0.0))
        return np.asarray(self["rms"] * np.transpose(parts)) if parts else None

    def _mean(self, first: int, count: int, s: Segment) -> float:
        """Mean of the settling over some columns of a frame."""
        width = s.prescan + s.columns + s.serial_overscan
        return float(self._shape(width)[first : first + count].mean()) if count else 0.0

    def _shape(self, width: int) -> FloatArray:
        """Settling by column of the frame in readout order, 1 at the first."""
        return np.asarray(np.exp(-np.arange(width) / self["length"]))
