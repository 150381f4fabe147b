"""Correlated read noise: in time, between amplifiers, or as a picked-up wave."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from bfsensor.effects.effect import Axes, Image, Layout, Parameter, Seen
from bfsensor.effects.read_noise import ReadNoise, added
from bfsensor.typing import FloatArray

RMS = Parameter("rms", "e-", 0.5, 4.0, amplitude=True)
"""Strength of the noise.  Range chosen; with a top twice as high its prior density falls by a
quarter, which lowers the evidence of every detection by as much."""

FREQUENCIES = 20
"""Number of frequencies from which fits of a wave begin.

Derived: from periods of 5 to 60 pixel times they are 0.0096 cycles per pixel time apart, less than
the resolution 1 / 64 = 0.016 of the 32 measured lags."""


class NoiseInTime(ReadNoise):
    """Noise of ``rms`` whose correlation with the pixel read before is ``corr``.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.5 to 4 (0 changes nothing); ``corr``: 0.3 to 0.95.

    Examples
    --------
    >>> NoiseInTime({"rms": 1.0, "corr": 0.6}).name
    'correlated_noise:ar1'
    """

    word = "correlated_noise"
    variant = "ar1"
    parameters = (RMS, Parameter("corr", "", 0.3, 0.95, law="flat", ends=(-0.999, 0.999)))
    touches = ("bias_cov", "bias_level", "flat_cov")
    source = "First-order autoregression (Box & Jenkins 1970, section 3.2); range assumed"

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        rms, keep = self["rms"], self["corr"]
        if rms == 0:
            return frames
        out = []
        for frame in frames:
            fresh = rms * rng.standard_normal(frame.size)
            fresh[1:] *= np.sqrt(
                1 - keep**2
            )  # keeps the variance of all pixels but the first at rms^2
            out.append(lfilter([1.0], [1.0, -keep], fresh).reshape(frame.shape))
        return added(frames, out)

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        # Fits may try values of 1 and more, at which the correlation would not decay.
        keep = float(np.clip(self["corr"], -0.999, 0.999))
        return np.asarray(self["rms"] ** 2 * keep ** np.abs(lag))


SAMPLES = 2**16
"""Length of the series whose spectrum gives the covariances of flicker noise [pixel times].

Chosen: 256 rows of 256 pixels; twice as long, noise that is flatter than 1 / f changes by less than
1 % at measured lags, as the parameter ``rms`` is that of noise with a ``memory``."""


class FlickerNoise(ReadNoise):
    r"""Noise of ``rms`` whose power falls as :math:`(f^2 + f_0^2)^{-\alpha/2}` with the frequency f.

    f_0 = 1 / (2 pi memory): slower noise is white.  alpha is ``exponent``; 2 is the noise of one
    relaxation, as in the plain law, 1 that of many.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.5 to 4 (0 changes nothing); ``exponent``: 0.4 to 2;
        ``memory`` [pixel times]: 3 to 3000.

    Examples
    --------
    >>> FlickerNoise({"rms": 1.0, "exponent": 1.0, "memory": 100.0}).name
    'correlated_noise:flicker'
    """

    word = "correlated_noise"
    variant = "flicker"
    parameters = (
        RMS,
        Parameter("exponent", "", 0.4, 2.0, law="flat", ends=(0.0, 3.0)),
        Parameter("memory", "pixel times", 3.0, 3000.0),
    )
    touches = ("bias_cov", "bias_level", "flat_cov")
    source = (
        "Flicker noise of an output transistor: Janesick 2001, Scientific Charge-Coupled Devices, "
        "SPIE Press, section 6.2; sum of relaxations: McWhorter 1957; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"rms": 1.0, "exponent": v, "memory": memory}
            for v in (0.8, 1.4) for memory in (20.0, 300.0)
        ]  # fmt: skip

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        out = []
        for frame in frames:
            power = _power(frame.size, self["exponent"], self["memory"])
            white = np.fft.rfft(rng.standard_normal(frame.size))
            series = np.fft.irfft(white * np.sqrt(power), frame.size)
            out.append(self["rms"] * series.reshape(frame.shape))
        return added(frames, out)

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        c = _flicker(float(np.clip(self["exponent"], 0.0, 3.0)), self["memory"])
        near = np.minimum(np.abs(np.asarray(lag)).astype(int), len(c) - 1)
        return np.asarray(self["rms"] ** 2 * c[near])


def _power(size: int, exponent: float, memory: float) -> FloatArray:
    """Power by frequency of flicker noise in a series, of variance 1."""
    f = np.fft.rfftfreq(size)
    power = (f**2 + (2 * np.pi * memory) ** -2.0) ** (-0.5 * exponent)
    return np.asarray(power / np.fft.irfft(power, size)[0])


@lru_cache(maxsize=64)
def _flicker(exponent: float, memory: float) -> FloatArray:
    """Correlation of flicker noise by lag, up to half of :data:`SAMPLES`."""
    power = _power(SAMPLES, exponent, memory)
    return np.asarray(np.fft.irfft(power, SAMPLES)[: SAMPLES // 2])


class CommonNoise(ReadNoise):
    """Noise of ``rms``, white in time and the same in all amplifiers.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.5 to 4 (0 changes nothing).

    Examples
    --------
    >>> CommonNoise({"rms": 1.0}).name
    'correlated_noise:common'
    """

    word = "correlated_noise"
    variant = "common"
    parameters = (RMS,)
    touches = ("bias_cov", "amp_cross", "flat_cov")
    source = (
        "Common-mode noise of the outputs of one CCD: Proc. SPIE 9154, 91542S (2014), where dummy "
        "outputs measure it; range assumed"
    )

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        shared = self["rms"] * rng.standard_normal(frames[0].shape)
        return added(frames, [shared] * len(frames))

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        return np.where(lag == 0, self["rms"] ** 2, 0.0)

    def amp_cross(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.where(axes["what"] == "noise", self["rms"] ** 2, 0.0)


class Pickup(ReadNoise):
    """A sine wave of ``rms`` and ``period`` in all amplifiers, with a random phase in each frame.

    The difference of two frames holds from 0 to 4 times its power, 2 on average, as the phases
    differ: over n pairs the measured power scatters by sqrt(1 / 2n) of itself.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rms`` [e-]: 0.3 to 3 (0 changes nothing); ``period`` [pixel times]: 5
        to 60.

    Examples
    --------
    >>> Pickup({"rms": 0.9, "period": 20.0}).name
    'correlated_noise:pickup'
    """

    word = "correlated_noise"
    variant = "pickup"
    parameters = (
        Parameter("rms", "e-", 0.3, 3.0, amplitude=True),
        Parameter("period", "pixel times", 5.0, 60.0),
    )
    touches = ("bias_cov", "bias_level", "amp_cross", "flat_cov")
    source = "Pickup of a few e- in the video chain: Proc. SPIE 9154, 91542S (2014); range assumed"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        low, high = (1 / p for p in (cls.parameters[1].high, cls.parameters[1].low))
        found = [
            float(s["period"]) for s in seen if s["word"] == "bias_cov" and "period" in s
        ]
        grid = 1 / np.linspace(low, high, FREQUENCIES)
        return [{"rms": 1.0, "period": float(p)} for p in (*found[:3], *grid)]

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        if self["rms"] == 0:
            return frames
        turns = np.arange(frames[0].size).reshape(frames[0].shape) / self["period"]
        wave = np.sqrt(2.0) * self["rms"] * np.cos(2 * np.pi * (turns - rng.random()))
        return added(frames, [wave] * len(frames))

    def in_order(self, lag: NDArray, width: NDArray) -> FloatArray:
        return np.asarray(self["rms"] ** 2 * np.cos(2 * np.pi * lag / self["period"]))

    def amp_cross(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.where(axes["what"] == "noise", self["rms"] ** 2, 0.0)
