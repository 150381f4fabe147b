"""Laws of fixed shifts of pixel edges: rings, rims, stitches, tears.

Light that lands between the nominal and the moved edge changes pixels, so that flats see areas and
spots see places; the sum over the sensor stays as it was, but for what crosses its rim.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from validation.foreign.device import REFERENCE, absorption_length
from validation.foreign.law import Law, law
from validation.foreign.laws_silicon import either_sign


class _Fixed(Law):
    """Edges shifted by a pattern that is computed once, times a factor by condition."""

    def pattern(self, x, y, axis, exposure):
        """Shift of edges at x, y [pixel] along an axis, for amplitude 1."""
        raise NotImplementedError

    def factor(self, exposure) -> float:
        """Strength at an exposure's condition, 1 at the first."""
        return 1.0

    def key(self, exposure):
        """What the pattern depends on beside the condition."""
        return 0

    def _patterns(self, exposure):
        """Patterns of right and upper edges, and of the sensor's left and lower rim."""
        key = ("pattern", self.key(exposure))
        if key not in self.state:
            n = self.setting.layout.pixels
            y, x = np.mgrid[0:n, 0:n].astype(np.float64)
            along, rim = np.arange(n, dtype=float), np.full(n, -0.5)
            parts = (
                self.pattern(x + 0.5, y, "x", exposure),
                self.pattern(x, y + 0.5, "y", exposure),
                self.pattern(rim, along, "x", exposure),
                self.pattern(along, rim, "y", exposure),
            )
            self.state[key] = tuple(np.asarray(p, np.float32) for p in parts)
        return self.state[key]

    def fixed_edges(self, dx, dy, exposure):
        px, py, _, _ = self._patterns(exposure)
        f = np.float32(self.values[self.amplitude] * self.factor(exposure))
        return dx + f * px, dy + f * py

    def light(self, light, exposure):
        """Light that crosses the rim comes from outside, not from the other end of the sensor."""
        px, py, left, low = self._patterns(exposure)
        f = np.float32(self.values[self.amplitude] * self.factor(exposure))
        rate = light.rate.copy()
        rate[:, 0] += f * (light.across_x[:, -1] * px[:, -1] - rate[:, 0] * left)
        rate[0] += f * (light.across_y[-1] * py[-1] - rate[0] * low)
        return replace(light, rate=rate)


class _Rings(_Fixed):
    def radial(self, r):
        raise NotImplementedError

    @staticmethod
    def centre(rng, setting):
        """Centre of the wafer, as seen from a sensor near it or far from it [pixel]."""
        n = setting.layout.pixels
        far = rng.uniform(0.2, 1.6) * n
        angle = rng.uniform(0, 2 * np.pi)
        return {
            "xc": float(round(n / 2 + far * np.cos(angle), 1)),
            "yc": float(round(n / 2 + far * np.sin(angle), 1)),
        }

    def pattern(self, x, y, axis, exposure):
        rx, ry = x - self.values["xc"], y - self.values["yc"]
        r = np.hypot(rx, ry)
        return self.radial(r) * (rx if axis == "x" else ry) / np.maximum(r, 1.0)


@law(
    "tree_rings",
    "one_period",
    amplitude="amp",
    start=0.006,
    limits=(2e-05, 0.3),
    source="Plazas, Bernstein & Sheldon 2014 (PASP 126, 750): radial shift; area "
    "change is its divergence; here one period",
)
class RingsOnePeriod(_Rings):
    """Edges shift along the radius by amp cos(2 pi r / period + phase)."""

    @classmethod
    def draw(cls, rng, setting):
        period = float(round(np.exp(rng.uniform(np.log(8), np.log(60))), 2))
        return {
            **cls.centre(rng, setting),
            "period": period,
            "phase": float(rng.uniform(0, 6.28)),
        }

    def radial(self, r):
        return np.cos(2 * np.pi * r / self.values["period"] + self.values["phase"])


@law(
    "tree_rings",
    "growing_sum",
    amplitude="amp",
    start=0.006,
    limits=(2e-05, 0.3),
    source="Park et al. 2020 (JATIS 6, 011005) and Esteves et al. 2023 (PASP 135, "
    "115003): several periods, amplitude growing with radius; weaker for "
    "red light and higher bias",
)
class RingsGrowingSum(_Rings):
    """Four periods whose amplitudes grow with (r / r0)^growth; amp is the rms times sqrt 2.

    Light that is absorbed deep drifts less: the factor is the share of the thickness crossed; a
    drift field in proportion to the voltage gives V0 / V.
    """

    @classmethod
    def draw(cls, rng, setting):
        periods = np.exp(rng.uniform(np.log(7), np.log(70), 4))
        return {
            **cls.centre(rng, setting),
            "period": float(round(np.exp(np.mean(np.log(periods))), 2)),
            "periods": [float(round(p, 2)) for p in periods],
            "weights": [float(round(w, 3)) for w in rng.dirichlet(np.full(4, 2.0)) ** 0.5],
            "phases": [float(p) for p in rng.uniform(0, 6.28, 4)],
            "growth": float(round(rng.uniform(0.5, 2.0), 3)),
        }

    def radial(self, r):
        v = self.values
        waves = sum(
            w * np.cos(2 * np.pi * r / p + f)
            for w, p, f in zip(v["weights"], v["periods"], v["phases"], strict=True)
        )
        return waves * (r / self.setting.layout.pixels) ** v["growth"]

    def factor(self, exposure):
        t = self.setting.nominal.thickness
        depth = min(absorption_length(exposure.wavelength), t / 2)
        return (1 - depth / t) * REFERENCE[1] / exposure.back_bias


class _Rim(_Fixed):
    def fall(self, distance):
        raise NotImplementedError

    def pattern(self, x, y, axis, exposure):
        n = self.setting.layout.pixels
        at = x if axis == "x" else y
        if axis not in self.values["axes"]:
            return np.zeros_like(at)
        low, high = at + 0.5, n - 0.5 - at
        shift = self.fall(low) - self.fall(high)
        # the outermost edges end the sensor: nothing crosses them
        return np.where((high < 0.25) | (low < 0.25), 0.0, shift)


@law(
    "edge_rolloff",
    "exponential",
    amplitude="amp",
    start=0.03,
    limits=(0.0001, 2.0),
    source="Plazas et al. 2014 (glowing edges of DECam); Bradshaw et al. 2015 "
    "(JINST 10, C04034): amp exp(-d / length)",
)
class RimExponential(_Rim):
    """Edges within a few lengths of the rim shift by amp exp(-d / length), inwards or outwards."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **either_sign(rng),
            "length": float(round(rng.uniform(1.5, 9.0), 3)),
            "axes": str(rng.choice(["xy", "x", "y"])),
        }

    def fall(self, distance):
        return np.exp(-np.maximum(distance, 0) / self.values["length"])


@law(
    "edge_rolloff",
    "power",
    amplitude="amp",
    start=0.03,
    limits=(0.0001, 2.0),
    source="O'Connor 2015/2019 (guard-ring field of thick sensors): field of a "
    "line charge outside the rim, a power of the distance; amp (1 + "
    "d/length)^-p",
)
class RimPower(RimExponential):
    """Edges shift by amp (1 + d / length)^-exponent."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **super().draw(rng, setting),
            "exponent": float(round(rng.uniform(1.5, 4), 2)),
        }

    def fall(self, distance):
        base = 1 + np.maximum(distance, 0) / self.values["length"]
        return base ** -self.values["exponent"]


@law(
    "mask_stitch",
    "step",
    amplitude="amp",
    start=0.004,
    limits=(2e-05, 0.2),
    source="Baumer & Roodman 2015 (arXiv 1412.5136): pixel sizes; Smith & Rahmer "
    "2008 (SPIE 7021): one boundary in each mask step displaced",
)
class StitchStep(_Fixed):
    """One boundary of columns in each period is displaced by amp; its neighbours are not."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **either_sign(rng),
            "period": float(rng.integers(8, 64)),
            "phase": float(rng.integers(0, 8)),
            "axis": str(rng.choice(["x", "y"])),
        }

    def wave(self, at):
        return (
            np.floor(at - 0.5 + self.values["phase"]) % self.values["period"] == 0
        ) * 1.0

    def pattern(self, x, y, axis, exposure):
        at = x if axis == "x" else y
        return self.wave(at) if axis == self.values["axis"] else np.zeros_like(at)


@law(
    "mask_stitch",
    "wave",
    amplitude="amp",
    start=0.004,
    limits=(2e-05, 0.2),
    source="Kotov et al. 2010 (NIM A 652, 524, pixel sizes of LSST prototypes): "
    "the mask's step and repeat error runs on within a field; a sine of the"
    " column",
)
class StitchWave(StitchStep):
    """Boundaries are displaced by amp sin(2 pi x / period)."""

    @classmethod
    def draw(cls, rng, setting):
        return {**super().draw(rng, setting), "period": float(round(rng.uniform(5, 45), 2))}

    def wave(self, at):
        return np.sin(2 * np.pi * (at + self.values["phase"]) / self.values["period"])


@law(
    "tearing",
    "divisadero",
    amplitude="amp",
    start=0.01,
    limits=(0.0001, 0.6),
    source="Juramy et al. 2020 (arXiv 2002.09439): holes missing along one column "
    "boundary; edges lean to it as amp exp(-d/length)",
)
class TearColumn(_Fixed):
    """Edges near one column boundary lean towards it, the same in all rows."""

    @classmethod
    def draw(cls, rng, setting):
        n, w = setting.layout.pixels, setting.layout.width
        between = rng.random() < 0.6 and w < n
        at = int(w * rng.integers(1, n // w)) if between else int(rng.integers(20, n - 20))
        length = float(round(rng.uniform(1.2, 5.0), 3))
        return {**either_sign(rng), "length": length, "column": at / n}

    def line(self, y):
        return self.values["column"] * self.setting.layout.pixels - 0.5

    def pattern(self, x, y, axis, exposure):
        if axis == "y":
            return np.zeros_like(x)
        d = x - self.line(y)
        return -np.sign(d) * np.exp(-np.abs(d) / self.values["length"])


@law(
    "tearing",
    "ragged",
    amplitude="amp",
    start=0.012,
    limits=(0.0001, 0.6),
    source="Doherty et al. 2014 (SPIE 9154) and Juramy et al. 2020: a tear wanders"
    " along the rows and ends where holes were restored; gone after a purge",
)
class TearRagged(TearColumn):
    """The tear's column wanders over the rows, and it is there until a purge at an exposure."""

    @classmethod
    def draw(cls, rng, setting):
        n = setting.layout.pixels
        last = len(setting.plan.exposures())
        return {
            **super().draw(rng, setting),
            "column": float(round(rng.uniform(0.2, 0.8), 3)),
            "wander": float(round(rng.uniform(3, 10), 2)),
            "rows": [int(n * rng.uniform(0, 0.3)), int(n * rng.uniform(0.6, 1.0))],
            "until": int(last * rng.uniform(0.5, 1.0)),
        }

    def line(self, y):
        n, v = self.setting.layout.pixels, self.values
        wave = np.sin(5.1 * y / n + 1) + 0.5 * np.sin(17.3 * y / n)
        return v["column"] * n - 0.5 + v["wander"] * wave

    def pattern(self, x, y, axis, exposure):
        low, high = self.values["rows"]
        return super().pattern(x, y, axis, exposure) * ((y >= low) & (y < high))

    def factor(self, exposure):
        return float(exposure.sequence < self.values["until"])
