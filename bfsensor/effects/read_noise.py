"""Base class of amplifier noise that is defined by its covariance, and its change of each channel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.effect import Axes, Effect, Image, Layout
from bfsensor.typing import FloatArray

READOUT_LAGS = 32
"""Largest lag at which the noise of biases is measured in readout order [pixel times].

Chosen: twice as large, waves are resolved to 1 / 128 instead of 1 / 64 cycles per pixel time."""


def near_lags(width: int) -> NDArray:
    """Lags within a row of ``width`` pixels whose covariances the channel ``bias_cov`` measures."""
    return np.arange(1, min(READOUT_LAGS, width // 2) + 1)


class ReadNoise(Effect):
    """Noise added to the frames besides white noise; subclasses draw it and give its covariance.

    :meth:`in_order` is the covariance of two pixels read ``lag`` pixel times apart, averaged over a
    frame of the given width; :meth:`on_frame` that of pixels ``i`` columns and ``j`` rows apart.
    """

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        """Covariance by lag in readout order [e-^2]."""
        raise NotImplementedError

    def on_frame(self, i: NDArray, j: NDArray, width: float) -> FloatArray:
        """Covariance by lag in columns and rows [e-^2]."""
        return self.in_order(np.abs(i + width * j), np.asarray(width))

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        # Lags of a periodic array: its second half holds the negative ones.
        i, j = (np.fft.fftfreq(n, 1 / n).round() for n in (c.shape[-1], c.shape[-2]))
        out = np.array(c)
        widths = layout.frame_width(axes["amp"])
        for width in np.unique(widths):
            out[widths == width] += self.on_frame(i[None, :], j[:, None], float(width))
        return out

    def bias_cov(self, axes: Axes, layout: Layout) -> FloatArray:
        return self.in_order(axes["lag"], layout.frame_width(axes["amp"]))

    def bias_level(self, axes: Axes, layout: Layout) -> FloatArray:
        out = np.zeros(len(axes["amp"]))
        widths = layout.frame_width(axes["amp"])
        for width in np.unique(widths):
            # Variance of the mean of a row above that of white noise; covariances at near lags are
            # left out, as the channel bias_cov holds them already.
            lag = np.arange(len(near_lags(int(width))) + 1.0, width)
            tied = self.on_frame(lag, np.zeros(len(lag)), float(width))
            rows = (widths == width) & (axes["what"] == "rows")
            out[rows] = 2.0 / width * float((1 - lag / width) @ tied)
        return out


def added(frames: list[Image], noises: list[NDArray]) -> list[Image]:
    """Frames with noise added, each in its own floating-point type."""
    return [f + n.astype(f.dtype) for f, n in zip(frames, noises, strict=True)]
