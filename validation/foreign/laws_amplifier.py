"""Laws of amplifier and converter: memory, gain, crosstalk, codes."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from validation.foreign.law import Law, law
from validation.foreign.laws_silicon import either_sign


# -------------------------------------------------------------------- memory
class _Memory(Law):
    def echo(self, frame):
        """What earlier pixels add to each pixel of a frame [e-]."""
        raise NotImplementedError

    def amplifiers(self, frames, exposure):
        if not self.values["alpha"]:
            return frames
        return [f + self.echo(f).astype(np.float32) for f in frames]


_MEMORY = {"needs": ("serial_overscan",), "limits": (1e-7, 0.05), "amplitude": "alpha"}


@law(
    "electronic_memory",
    "previous_pixel",
    start=3e-05,
    source="catalogue item 26; incomplete settling of a sample, first order: alpha S(n-1)",
    **_MEMORY,
)
class PreviousPixel(_Memory):
    """alpha of the previous pixel is added."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def echo(self, frame):
        out = np.zeros_like(frame)
        out[:, 1:] = np.float32(self.values["alpha"]) * frame[:, :-1]
        return out


@law(
    "electronic_memory",
    "settling",
    start=3e-06,
    source="Horowitz & Hill, RC settling of the chain: sum over earlier pixels of "
    "alpha exp(-(n-1)/tau)",
    **_MEMORY,
)
class Settling(_Memory):
    """All earlier pixels are added, alpha exp(-(n - 1) / tau) of the one n before."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "tau": float(round(rng.uniform(0.7, 6.0), 3))}

    def echo(self, frame):
        decay = np.exp(-1 / self.values["tau"])
        return lfilter([0.0, self.values["alpha"]], [1.0, -decay], frame, axis=1)


@law(
    "electronic_memory",
    "threshold_and_decay",
    start=3e-05,
    source="Snyder et al. 2021 (JATIS 7, 048002): offset_n = max(scale max(S_n - "
    "threshold, 0), offset_(n-1) exp(-1/decay)), added to pixel n",
    **_MEMORY,
)
class ThresholdDecay(_Memory):
    """The offset jumps to alpha (S - threshold) and decays over the pixels after."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "threshold": float(round(rng.uniform(0, 5e4))),
            "tau": float(round(rng.uniform(1.0, 8.0), 3)),
        }

    def echo(self, frame):
        v = self.values
        decay, old = np.float32(np.exp(-1 / v["tau"])), np.zeros(len(frame), np.float32)
        out = np.zeros_like(frame)
        for c in range(frame.shape[1]):
            new = np.float32(v["alpha"]) * np.maximum(
                frame[:, c] - np.float32(v["threshold"]), 0
            )
            old = np.maximum(new, old * decay)
            out[:, c] = old
        return out


# -------------------------------------------------------------------- nonlinearity
class _Curve(Law):
    def change(self, q):
        """Relative change of the response at a signal [e-]."""
        raise NotImplementedError

    def amplifiers(self, frames, exposure):
        if not self.size:
            return frames
        return [f * (1 + self.change(f).astype(np.float32)) for f in frames]


@law(
    "gain_nonlinearity",
    "polynomial",
    amplitude="c2",
    start=0.0035,
    limits=(2e-05, 0.3),
    source="Bernstein et al. 2017 (PASP 129, 114502); S (1 + c2 S/1e5 + c3 (S/1e5)^2)",
)
class Polynomial(_Curve):
    """c2, and c3 in a ratio to it."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "ratio": float(round(rng.uniform(-0.8, 0.8), 3))}

    def settle(self):
        self.values["c3"] = self.values.get("c2", 0.0) * self.values.get("ratio", 0.0)

    def change(self, q):
        x = q * np.float32(1e-5)
        return np.float32(self.values["c2"]) * x + np.float32(self.values["c3"]) * x * x


@law(
    "gain_nonlinearity",
    "kink",
    amplitude="c",
    start=0.01,
    limits=(2e-05, 0.4),
    source="SDSS imager CCDs (DR7 non-linearity pages: response linear to a level,"
    " then falling); a change of slope at one level",
)
class Kink(_Curve):
    """The slope changes by c above a level."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "level": float(round(rng.uniform(1.5e4, 9e4)))}

    def change(self, q):
        above = np.maximum(q - np.float32(self.values["level"]), 0)
        return np.float32(self.values["c"]) * above / np.maximum(q, 1)


@law(
    "gain_nonlinearity",
    "spline_table",
    amplitude="rms",
    start=0.004,
    limits=(1e-05, 0.1),
    source="Plazas Malagon et al. 2024 (arXiv 2404.14516): spline linearizer of "
    "the video chain; random knots of rms relative deviation",
)
class SplineTable(_Curve):
    """A cubic spline through ten random knots, without its constant and its slope."""

    @classmethod
    def draw(cls, rng, setting):
        return {"knots": [float(round(z, 4)) for z in rng.standard_normal(10)]}

    def change(self, q):
        if "table" not in self.state:
            x = np.linspace(0, 1.3e5, 10)
            y = np.array(self.values["knots"]) * x
            y = y - np.polyval(np.polyfit(x, y, 1), x)
            spline = CubicSpline(x, y)
            grid = np.linspace(0, 1.4e5, 2001)
            curve = (spline(grid) - spline(0)) / np.maximum(grid, grid[1])
            curve /= np.sqrt(np.mean(curve[:1800] ** 2))
            self.state["table"] = grid, curve
        return self.values["rms"] * np.interp(q, *self.state["table"])


@law(
    "gain_nonlinearity",
    "low_signal",
    amplitude="c",
    start=30,
    limits=(0.05, 800.0),
    source="Bernstein et al. 2017, section on DECam's response at low light: some "
    "CCDs lose charge at low signal; deficit c (1 - exp(-S/length)) [e-]",
)
class LowSignal(_Curve):
    """A step of c electrons that is complete above ``length`` electrons."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "length": float(round(rng.uniform(200, 5000)))}

    def change(self, q):
        q = np.maximum(q, 0)
        part = -np.expm1(-q / np.float32(self.values["length"]))
        return -np.float32(self.values["c"]) * part / np.maximum(q, 1)


class _Drift(Law):
    def change(self, hours):
        raise NotImplementedError

    def amplifiers(self, frames, exposure):
        if not self.values["slope"]:
            return frames
        return [f * np.float32(1 + self.change(exposure.hours)) for f in frames]


_DRIFT = {"amplitude": "slope", "start": 0.01, "limits": (1e-5, 0.3)}


@law(
    "gain_drift",
    "linear",
    source="catalogue item 32: gain against time, slope for each hour",
    **_DRIFT,
)
class DriftLinear(_Drift):
    """Gain rises in proportion to time."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def change(self, hours):
        return self.values["slope"] * hours


@law(
    "gain_drift",
    "warming_up",
    source="O'Connor et al. 2016 (SPIE 9915, readout electronics): 5e-4/K; a crate"
    " warms as 1 - exp(-t / tau)",
    **_DRIFT,
)
class DriftWarming(_Drift):
    """Gain settles: slope is that at the beginning."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "tau_hours": float(round(rng.uniform(0.15, 0.8), 3))}

    def change(self, hours):
        tau = self.values["tau_hours"]
        return -self.values["slope"] * tau * np.expm1(-hours / tau)


@law(
    "gain_drift",
    "thermal_cycle",
    source="as before, with a cooler that cycles: slope is the largest one of a "
    "sine of the time",
    **_DRIFT,
)
class DriftCycle(_Drift):
    """Gain follows a sine of the time."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "period_hours": float(round(rng.uniform(0.3, 1.5), 3))}

    def change(self, hours):
        w = 2 * np.pi / self.values["period_hours"]
        return self.values["slope"] / w * np.sin(w * hours)


# -------------------------------------------------------------------- crosstalk
class _Crosstalk(Law):
    def heard(self, frame):
        """What a victim hears of an aggressor's frame, for c = 1 [e-]."""
        raise NotImplementedError

    def strength(self, victim, aggressor):
        return 1.0

    def amplifiers(self, frames, exposure):
        c = np.float32(self.values["c"])
        if not c:
            return frames
        heard = [self.heard(f) for f in frames]
        out = []
        for v, frame in enumerate(frames):
            total = frame.copy()
            for a in range(len(frames)):
                if a != v and (s := self.strength(v, a)):
                    total += c * np.float32(s) * heard[a]
            out.append(total)
        return out


_TALK = {
    "needs": ("two_amplifiers", "spots"),
    "limits": (1e-7, 0.01),
    "amplitude": "c",
    "start": 4e-5,
}


@law(
    "amp_crosstalk",
    "linear",
    source="O'Connor 2015 (arXiv 1501.04137, JINST 10, C05010), coefficients between outputs of one "
    "sensor; the same fraction in all others",
    **_TALK,
)
class TalkLinear(_Crosstalk):
    """A fraction c of every other amplifier, pixel by pixel in time."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def heard(self, frame):
        return frame


@law(
    "amp_crosstalk",
    "nonlinear",
    source="Paech (DECam's crosstalk notes): linear up to an onset, a polynomial "
    "above; neighbours only",
    **_TALK,
)
class TalkNonlinear(_Crosstalk):
    """Adjacent amplifiers hear S + curve (S - onset)^2 / onset above an onset."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **either_sign(rng),
            "onset": float(round(rng.uniform(2e4, 6e4))),
            "curve": float(round(rng.uniform(0.5, 3.0), 3)),
        }

    def strength(self, victim, aggressor):
        return float(abs(victim - aggressor) == 1)

    def heard(self, frame):
        onset = np.float32(self.values["onset"])
        return (
            frame
            + np.float32(self.values["curve"]) * np.maximum(frame - onset, 0) ** 2 / onset
        )


@law(
    "amp_crosstalk",
    "delayed",
    source="Freyhammer et al. 2001 (Exp. Astron. 12, 147): victims of opposite "
    "sign and displaced by pixels; derivative of a delayed signal",
    **_TALK,
)
class TalkDelayed(_Crosstalk):
    """Hears the aggressor ``delay`` pixels late, and a share of its change."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **either_sign(rng),
            "delay": int(rng.integers(1, 3)),
            "derivative": float(round(rng.uniform(-0.5, 0.5), 3)),
        }

    def heard(self, frame):
        d = self.values["delay"]
        late = np.zeros_like(frame)
        late[:, d:] = frame[:, :-d]
        change = np.zeros_like(frame)
        change[:, 1:] = np.diff(late, axis=1)
        return late + np.float32(self.values["derivative"]) * change


# -------------------------------------------------------------------- converter
class _Codes(Law):
    """Works on whole codes; a part of a code is a chance, as the noise before the converter makes it."""

    def shifted(self, code, uniform):
        """Change of codes, as whole numbers [ADU]."""
        raise NotImplementedError

    def codes(self, frames, exposure):
        if not self.values["delta"]:
            return frames
        out = []
        for k, f in enumerate(frames):
            uniform = self.rng(exposure, k).random(f.shape, np.float32)
            out.append(f + self.shifted(f.astype(np.int64), uniform).astype(np.float32))
        return out


@law(
    "adc_bits",
    "bit_weight",
    amplitude="delta",
    start=0.6,
    limits=(0.003, 64.0),
    source="Janesick 2007, Photon Transfer, section 11 (ADC nonlinearity): one bit"
    " weighs delta codes more",
)
class BitWeight(_Codes):
    """Codes with a bit set (counted from 0) are higher by delta codes."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "bit": int(rng.integers(3, 12))}

    def shifted(self, code, uniform):
        return np.floor(
            self.values["delta"] * ((code >> int(self.values["bit"])) & 1) + uniform
        )


@law(
    "adc_bits",
    "wide_codes",
    amplitude="delta",
    start=0.15,
    limits=(0.001, 1.0),
    source="IEEE 1241 (differential nonlinearity): every 2^bit-th code is wider, "
    "at the cost of the next",
)
class WideCodes(_Codes):
    """Codes at multiples of 2^bit are wider by delta codes, the codes above narrower."""

    @classmethod
    def draw(cls, rng, setting):
        return {"bit": int(rng.integers(2, 6))}

    def shifted(self, code, uniform):
        next_one = code % 2 ** int(self.values["bit"]) == 1
        return -1.0 * (next_one & (uniform < self.values["delta"]))
