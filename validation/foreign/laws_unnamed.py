"""Laws that no class word describes: what a bench may do that nobody put in a library.

Some are published (binary offsets, vampire pixels, ghosts), some are inventions that keep to the
rules of a CCD; all of them are `outside_library` in a truth.
"""

from __future__ import annotations

import numpy as np

from validation.foreign.collection import Term
from validation.foreign.law import Law, law
from validation.foreign.laws_silicon import either_sign

OUT = "outside_library"


@law(
    OUT,
    "exchanged_axes",
    amplitude="share",
    start=0.6,
    limits=(0.002, 1.0),
    source="a fault of real pipelines: kernels read with exchanged axes; here the "
    "sensor's x law answers in y by a share",
)
class ExchangedAxes(Law):
    """Shifts are (1 - share) of the device's and share of those with exchanged axes."""

    def terms(self, terms, exposure):
        s = self.values["share"]
        return [
            Term((1 - s) * t.kx + s * t.ky.T, (1 - s) * t.ky + s * t.kx.T, t.source)
            for t in terms
        ]


@law(
    OUT,
    "binary_offset",
    amplitude="step",
    start=0.05,
    limits=(0.01, 30.0),
    needs=("serial_overscan",),
    source="Boone, Aldering, Copin et al. 2018 (PASP 130, 064504): an offset by "
    "the number of set bits of the pixel read one to three before",
)
class BinaryOffset(Law):
    """Codes rise by step times (set bits of the code ``lag`` pixels before, less 8) [ADU]."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "lag": int(rng.integers(1, 4))}

    def codes(self, frames, exposure):
        lag, step, out = int(self.values["lag"]), self.values["step"], []
        if not step:
            return frames
        for k, frame in enumerate(frames):
            code = np.clip(frame, 0, 65535).astype(np.uint16)
            bits = np.unpackbits(code.view(np.uint8).reshape(*code.shape, 2), axis=-1).sum(
                -1
            )
            late = np.full(code.shape, 8.0)
            late[:, lag:] = bits[:, :-lag]
            # steps below one code are dithered, as the converter's own noise would
            dither = self.rng(exposure, k).random(code.shape) - 0.5
            out.append(frame + np.rint(step * (late - 8) + dither))
        return out


@law(
    OUT,
    "row_droop",
    amplitude="share",
    start=1e-07,
    limits=(1e-09, 0.003),
    source="invention: the clamp's supply sags with the charge read in a row; all "
    "later pixels of the row and the next row's begin sit lower",
)
class RowDroop(Law):
    """Each pixel loses share times the running sum of the row, which relaxes over ``length`` pixels."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "length": float(round(rng.uniform(40, 400), 1))}

    def amplifiers(self, frames, exposure):
        from scipy.signal import lfilter

        share = self.values["share"]
        if not share:
            return frames
        decay, out = np.exp(-1 / self.values["length"]), []
        for f in frames:
            # the rows follow one another in time
            sag = lfilter([0.0, share], [1.0, -decay], f.ravel().astype(np.float64))
            out.append(f - sag.reshape(f.shape).astype(np.float32))
        return out


@law(
    OUT,
    "odd_rows",
    amplitude="delta",
    start=0.15,
    limits=(0.001, 1.0),
    source="invention after Smith & Rahmer 2008: alternate rows have barriers of "
    "another height, so that shifts of odd and even rows differ",
)
class OddRows(Law):
    """Shifts of edges in odd rows are larger by delta, in even rows smaller."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def modulation(self, exposure):
        d = self.values["delta"]
        if not d:
            return None
        sign = np.where(np.arange(self.setting.layout.pixels) % 2, 1 + d, 1 - d)
        sign = sign.astype(np.float32)[:, None]
        return lambda dx, dy, charge: (dx * sign, dy * sign)


@law(
    OUT,
    "curl",
    amplitude="share",
    start=0.5,
    limits=(0.002, 1.5),
    source="Broughton et al. 2024: a curl of the shifts is not seen in flats; here"
    " shifts turned by 90 degrees, as a drift across a magnetic field",
)
class Curl(Law):
    """Shifts across the direction to the charge: (kx, ky) + share (-ky', kx'), on the other edges."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def terms(self, terms, exposure):
        s = self.values["share"]
        out = []
        for t in terms:
            # a field on upper edges, averaged to the right edges around, and the other way round
            up = 0.25 * (t.ky + np.roll(t.ky, 1, 0) + np.roll(t.ky, -1, 1) + _both(t.ky))
            right = 0.25 * (
                t.kx + np.roll(t.kx, 1, 1) + np.roll(t.kx, -1, 0) + _both2(t.kx)
            )
            out.append(Term(t.kx - s * up, t.ky + s * right, t.source))
        return out


def _both(k):
    return np.roll(np.roll(k, 1, 0), -1, 1)


def _both2(k):
    return np.roll(np.roll(k, 1, 1), -1, 0)


@law(
    OUT,
    "mirror_ghost",
    amplitude="frac",
    start=0.0002,
    limits=(1e-06, 0.05),
    needs=("spots",),
    source="Eikenberry & O'Brien (optical ghosts of filters and windows): a faint "
    "image turned by 180 degrees, defocused",
)
class MirrorGhost(Law):
    """A fraction of the light makes a turned image, blurred over ``length`` pixels."""

    @classmethod
    def draw(cls, rng, setting):
        return {"length": float(round(rng.uniform(2, 12), 2))}

    def light(self, light, exposure):
        if exposure.kind != "SPOT" or not self.values["frac"]:
            return light
        from scipy.ndimage import uniform_filter

        ghost = uniform_filter(
            light.rate[::-1, ::-1], int(self.values["length"]), mode="wrap"
        )
        return light.plus(np.float32(self.values["frac"]) * ghost)


@law(
    OUT,
    "phase_gain",
    amplitude="amp",
    start=0.001,
    limits=(5e-06, 0.05),
    source="invention after interleaved converters (IEEE 1241, interleaving "
    "spurs): four converters take turns along a row and differ in gain",
)
class PhaseGain(Law):
    """Gain by column modulo four: amp times (1, -1, 0.5, -0.5) in some order, for signal only."""

    @classmethod
    def draw(cls, rng, setting):
        return {"pattern": [float(x) for x in rng.permutation([1.0, -1.0, 0.5, -0.5])]}

    def amplifiers(self, frames, exposure):
        pattern = np.array(self.values["pattern"])
        width = frames[0].shape[1]
        gain = 1 + self.values["amp"] * np.resize(pattern, width)
        return [f * gain.astype(np.float32) for f in frames]


@law(
    OUT,
    "vampires",
    amplitude="depth",
    start=0.05,
    limits=(0.0005, 0.9),
    source="Utsumi et al. 2024 and LSSTCam's SITCOMTN-148 ('vampire pixels'): a "
    "pixel draws charge from its surroundings, more at higher signal",
)
class Vampires(Law):
    """Some pixels draw from rings around them, depth (1 + growth Q / 1e5) of the pixel's light."""

    @classmethod
    def draw(cls, rng, setting):
        n, count = setting.layout.pixels, int(rng.integers(3, 12))
        return {
            "x": [int(v) for v in rng.integers(8, n - 8, count)],
            "y": [int(v) for v in rng.integers(8, n - 8, count)],
            "growth": float(round(rng.uniform(0.3, 2.0), 3)),
        }

    def stored(self, charge, exposure):
        v, out = self.values, charge.copy()
        if not v["depth"]:
            return charge
        for x, y in zip(v["x"], v["y"], strict=True):
            box = out[y - 3 : y + 4, x - 3 : x + 4]
            yy, xx = np.mgrid[-3:4, -3:4]
            share = np.exp(-0.5 * (xx**2 + yy**2) / 2.0)
            share[3, 3] = 0
            share /= share.sum()
            level = float(np.median(box))
            taken = v["depth"] * level * (1 + v["growth"] * level / 1e5)
            part = np.minimum(taken * share, 0.9 * np.maximum(box, 0))
            box -= part.astype(np.float32)
            box[3, 3] += part.sum()
        return out


@law(
    OUT,
    "previous_mean",
    amplitude="share",
    start=1e-05,
    limits=(1e-07, 0.01),
    source="invention: a slow integrator of the chain follows the mean of the "
    "frame before, so that offsets depend on the exposure before",
)
class PreviousMean(Law):
    """All pixels of a frame sit higher by share times the mean of the frame before, fading along x."""

    @classmethod
    def draw(cls, rng, setting):
        return {"length": float(round(rng.uniform(20, 200), 1))}

    def amplifiers(self, frames, exposure):
        past = self.state.get("past", [0.0] * len(frames))
        self.state["past"] = [float(f.mean()) for f in frames]
        if not self.values["share"]:
            return frames
        x = np.exp(-np.arange(frames[0].shape[1]) / self.values["length"])
        return [
            f + np.float32(self.values["share"] * p) * x.astype(np.float32)
            for f, p in zip(frames, past, strict=True)
        ]
