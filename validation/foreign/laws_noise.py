"""Laws of noise and bias levels, in the order of reading."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from validation.foreign.law import Law, law


# -------------------------------------------------------------------- noise
class _Noise(Law):
    """Noise in readout order; one series for each amplifier unless it is common to all."""

    def series(self, count, rng):
        """Noise of unit rms, in the order of time."""
        raise NotImplementedError

    common = False

    def noise(self, frames, exposure):
        rms = np.float32(self.values[self.amplitude])
        if not rms:
            return frames
        rng = self.rng(exposure)
        first = self.series(frames[0].size, rng).astype(np.float32)
        out = []
        for k, frame in enumerate(frames):
            x = (
                first
                if self.common or not k
                else self.series(frame.size, rng).astype(np.float32)
            )
            out.append(frame + rms * x.reshape(frame.shape))
        return out


_NOISE = {"amplitude": "rms", "start": 1.5, "limits": (0.03, 60.0), "power": 2.0}
_BESIDE = {"beside": ("popcorn_noise", "heavy_tailed_noise")}


@law(
    "correlated_noise",
    "autoregressive",
    source="catalogue item 30: AR(1) in pixel time",
    **_NOISE,
    **_BESIDE,
)
class NoiseAR(_Noise):
    """Each pixel's noise keeps a share corr of the one before."""

    @classmethod
    def draw(cls, rng, setting):
        return {"corr": float(round(rng.uniform(0.2, 0.95), 3))}

    def series(self, count, rng):
        a = self.values["corr"]
        return lfilter([np.sqrt(1 - a * a)], [1.0, -a], rng.standard_normal(count))


@law(
    "correlated_noise",
    "pickup_line",
    source="Antilogus et al. 2017 and catalogue item 30: pickup of a power "
    "supply's line, coherent over amplifiers, phase at random in each frame",
    **_NOISE,
    **_BESIDE,
)
class NoisePickup(_Noise):
    """A sine of the pixel's time; its frequency wanders a little."""

    common = True

    @classmethod
    def draw(cls, rng, setting):
        return {"period": float(round(np.exp(rng.uniform(np.log(2.3), np.log(90))), 3))}

    def series(self, count, rng):
        period = self.values["period"] * (1 + 1e-4 * rng.standard_normal())
        phase = 2 * np.pi * (np.arange(count) / period + rng.random())
        return np.sqrt(2) * np.sin(phase)


@law(
    "correlated_noise",
    "pink",
    source="Janesick 2001, section 6.2 (flicker noise of the output amplifier): "
    "power 1/f^exponent above a knee",
    **_NOISE,
    **_BESIDE,
)
class NoisePink(_Noise):
    """Power 1 / f^exponent in pixel time."""

    @classmethod
    def draw(cls, rng, setting):
        return {"exponent": float(round(rng.uniform(0.7, 1.6), 3))}

    def series(self, count, rng):
        f = np.fft.rfftfreq(count)
        f[0] = np.inf
        low = 1 / 20000.0
        a = np.maximum(f, low) ** (-self.values["exponent"] / 2)
        x = np.fft.irfft(np.fft.rfft(rng.standard_normal(count)) * a, count)
        return x / x.std()


@law(
    "correlated_noise",
    "common_mode",
    source="Antilogus et al. 2017 (correlated noise between channels); white in "
    "time, shared by all amplifiers",
    **{**_NOISE, "needs": ("two_amplifiers",)},
    **_BESIDE,
)
class NoiseCommon(_Noise):
    """The same white noise in all amplifiers."""

    common = True

    def series(self, count, rng):
        return rng.standard_normal(count)


class _Bias(Law):
    def offset(self, shape, exposure, number):
        """Offset of unit rms [e-]."""
        raise NotImplementedError

    def noise(self, frames, exposure):
        rms = np.float32(self.values[self.amplitude])
        if not rms:
            return frames
        return [
            f + rms * np.asarray(self.offset(f.shape, exposure, k), np.float32)
            for k, f in enumerate(frames)
        ]


_BIAS = {
    "amplitude": "rms", "start": 1.0, "limits": (0.02, 200.0), "power": 2.0,
    "beside": ("bias_structure", "bias_drift", "popcorn_noise"),
}  # fmt: skip


@law(
    "bias_instability",
    "frames",
    source="catalogue item 31: the level jumps between frames",
    **_BIAS,
)
class BiasFrames(_Bias):
    """Each frame of each amplifier has a level of its own, overscan included."""

    def offset(self, shape, exposure, number):
        return self.rng(exposure, number).standard_normal()


@law(
    "bias_instability",
    "rows",
    source="Plazas Malagon et al. 2024: bias by row follows the overscan; offsets "
    "of rows with memory",
    **_BIAS,
)
class BiasRows(_Bias):
    """Rows have levels that keep a share of the row before."""

    @classmethod
    def draw(cls, rng, setting):
        return {"memory": float(round(rng.uniform(0.0, 0.97), 3))}

    def offset(self, shape, exposure, number):
        a = self.values["memory"]
        x = self.rng(exposure, number).standard_normal(shape[0])
        return lfilter([np.sqrt(1 - a * a)], [1.0, -a], x)[:, None]


@law(
    "bias_instability",
    "along_rows",
    source="Utsumi et al. 2024 (LSSTCam, two-dimensional bias that varies between "
    "frames): a ramp and a settling whose size differs from frame to frame",
    **_BIAS,
)
class BiasAlongRows(_Bias):
    """A settling exp(-x / length) at the begin of rows, of random size in each frame."""

    @classmethod
    def draw(cls, rng, setting):
        w = setting.layout.frame_shape[1]
        return {"length": float(round(rng.uniform(0.05, 0.5) * w, 2))}

    def offset(self, shape, exposure, number):
        x = np.exp(-np.arange(shape[1]) / self.values["length"])
        return (
            self.rng(exposure, number).standard_normal()
            * x[None, :]
            / np.sqrt(np.mean(x * x))
        )
