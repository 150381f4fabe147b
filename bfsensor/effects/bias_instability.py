"""Bias instability: the bias level varies from frame to frame or from row to row.

A shape that all frames share is no instability: it is subtracted with the biases' mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter
from bfsensor.effects.read_noise import ReadNoise, added
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
