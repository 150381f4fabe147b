"""Nuisances of real sensors and benches; cosmetics in a report, no effects.

Words are those of the contract (`cosmetics`, `kind`).  Each is drawn at the sizes that test benches
report; the sources stand with each.  Switched one by one, in nulls and beside laws.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from validation.foreign.law import Law, Setting
from validation.foreign.laws_light import straight_track

NUISANCES: dict[str, type[Law]] = {}

SEA_LEVEL = 1.0
"""Muons at sea level [1/cm^2/min] (Particle Data Group, cosmic rays)."""


def nuisance(word: str, source: str):
    """Register a nuisance."""

    def register(cls: type[Law]) -> type[Law]:
        cls.word, cls.name, cls.source = word, "nuisance", source
        NUISANCES[word] = cls
        return cls

    return register


def _ints(values) -> list[int]:
    return [int(v) for v in values]


def _rounded(values, digits=4) -> list[float]:
    return [float(round(v, digits)) for v in values]


@nuisance(
    "bad_column",
    "Janesick 2001, section 4: columns of low response; a few in a cosmetic grade 1",
)
class BadColumns(Law):
    """Columns, and single pixels, of 2 to 30 % low response."""

    @classmethod
    def draw(cls, rng, setting):
        n, count, single = (
            setting.layout.pixels,
            int(rng.integers(1, 9)),
            int(rng.integers(0, 40)),
        )
        return {
            # not the last ones: no edge of the sensor is modelled, charge there has none beside it
            "columns": _ints(3 + rng.choice(n - 6, count, replace=False)),
            "rows": _ints(rng.choice([0, 0, 1, 2], count) * n // 4),
            "size": _rounded(-np.exp(rng.uniform(np.log(0.02), np.log(0.3), count))),
            "pixels": [
                _ints(rng.integers(0, n, single)),
                _ints(rng.integers(0, n, single)),
            ],
            "pixel_size": _rounded(-np.exp(rng.uniform(np.log(0.03), np.log(0.6), single))),
        }

    def light(self, light, exposure):
        if "map" not in self.state:
            v, m = self.values, np.ones(self.setting.shape, np.float32)
            for c, r, s in zip(v["columns"], v["rows"], v["size"], strict=True):
                m[r:, c] *= 1 + s
            m[v["pixels"][1], v["pixels"][0]] *= 1 + np.array(v["pixel_size"], np.float32)
            self.state["map"] = m
        return light.scaled(self.state["map"])


@nuisance("hot_pixel", "Widenhorn et al. 2002: single sites of generation")
class HotPixels(Law):
    """Single hot pixels of 1 to 200 e-/s."""

    @classmethod
    def draw(cls, rng, setting):
        n, count = setting.layout.pixels, int(rng.integers(4, 20))
        return {
            "x": _ints(rng.integers(0, n, count)),
            "y": _ints(rng.integers(0, n, count)),
            "rate": _rounded(np.exp(rng.uniform(0, np.log(200), count)), 2),
        }

    def extra_charge(self, charge, exposure):
        if not exposure.seconds:
            return charge
        v, out = self.values, charge.copy()
        warm = 2 ** ((exposure.temperature + 100) / 7.0)
        mean = np.array(v["rate"]) * exposure.seconds * warm
        out[v["y"], v["x"]] += self.rng(exposure).poisson(mean).astype(np.float32)
        return out


@nuisance(
    "dust", "shadows of grains on a window near the focal plane: rings of a fast beam"
)
class Dust(Law):
    """Grains on the window: ring-shaped shadows of 0.3 to 3 %."""

    @classmethod
    def draw(cls, rng, setting):
        n, count = setting.layout.pixels, int(rng.integers(2, 12))
        return {
            "x": _rounded(rng.uniform(0, n, count), 1),
            "y": _rounded(rng.uniform(0, n, count), 1),
            "radius": _rounded(rng.uniform(4, 16, count), 2),
            "hole": _rounded(rng.uniform(0.0, 0.5, count), 2),
            "size": _rounded(-np.exp(rng.uniform(np.log(0.003), np.log(0.03), count))),
        }

    def light(self, light, exposure):
        if "map" not in self.state:
            n, v = self.setting.layout.pixels, self.values
            y, x = np.mgrid[0:n, 0:n]
            m = np.ones((n, n))
            for cx, cy, r, hole, s in zip(
                v["x"], v["y"], v["radius"], v["hole"], v["size"], strict=True
            ):
                d = np.hypot(x - cx, y - cy)
                rim = 1 / (1 + np.exp((d - r) / 0.7)) - 1 / (
                    1 + np.exp((d - hole * r) / 0.7)
                )
                m *= 1 + s * rim
            self.state["map"] = m.astype(np.float32)
        return light.scaled(self.state["map"])


@nuisance("vignetting", "cos^4 law and a stop: fall towards corners, of higher order")
class Vignetting(Law):
    """Flats fall as 1 - size (r^2 + higher r^4) towards the corners."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "size": float(round(np.exp(rng.uniform(np.log(0.003), np.log(0.04))), 5)),
            "higher": float(round(rng.uniform(0, 1.5), 3)),
            "centre": _rounded(rng.uniform(0.35, 0.65, 2), 3),
        }

    def light(self, light, exposure):
        if exposure.kind != "FLAT":
            return light
        if "map" not in self.state:
            n, v = self.setting.layout.pixels, self.values
            y, x = np.mgrid[0:n, 0:n] / n
            r2 = 2 * ((x - v["centre"][0]) ** 2 + (y - v["centre"][1]) ** 2)
            self.state["map"] = (1 - v["size"] * (r2 + v["higher"] * r2**2)).astype(
                np.float32
            )
        return light.scaled(self.state["map"])


@nuisance(
    "bias_structure",
    "Plazas Malagon et al. 2024: fixed two-dimensional bias of columns, rows, settling",
)
class BiasStructure(Law):
    """The same in all frames: columns and rows of 0.05 to 0.3 e- rms, settling at the begin of rows."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "columns": float(round(rng.uniform(0.05, 0.3), 4)),
            "rows": float(round(rng.uniform(0.05, 0.2), 4)),
            "settling": float(round(rng.uniform(-6, 6), 3)),
            "length": float(round(rng.uniform(2, 8), 2)),
        }

    def noise(self, frames, exposure):
        v, out = self.values, []
        for k, f in enumerate(frames):
            rng = self.rng(None, k)
            pattern = v["columns"] * rng.standard_normal(f.shape[1])
            pattern = pattern + v["settling"] * np.exp(-np.arange(f.shape[1]) / v["length"])
            rows = v["rows"] * rng.standard_normal(f.shape[0])
            out.append(f + (pattern[None, :] + rows[:, None]).astype(np.float32))
        return out


@nuisance(
    "bias_drift", "catalogue item 31: slow drift of the level with the rack's temperature"
)
class BiasDrift(Law):
    """The level wanders slowly over the campaign, and by a common 0.2 to 1 e- between frames."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "size": float(round(rng.uniform(1, 8), 3)),
            "hours": float(round(rng.uniform(0.3, 2), 3)),
            "rms": float(round(rng.uniform(0.2, 1.0), 3)),
        }

    def noise(self, frames, exposure):
        v = self.values
        slow = v["size"] * np.sin(2 * np.pi * exposure.hours / v["hours"] + 1)
        level = slow + v["rms"] * self.rng(exposure).standard_normal()
        return [f + np.float32(level * (1 + 0.1 * k)) for k, f in enumerate(frames)]


@nuisance(
    "lamp_flicker", "benches without feedback: 0.1 to 0.5 % from exposure to exposure"
)
class LampFlicker(Law):
    """The lamp's current differs between exposures; with or without a monitor that sees it."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "rms": float(round(rng.uniform(0.0008, 0.005), 6)),
            "monitor": bool(rng.random() < 0.7),
        }

    def lamp(self, level, exposure):
        return level * (1 + self.values["rms"] * self.rng(exposure).standard_normal())


@nuisance(
    "exposure_time",
    "shutters are timed to about a millisecond; headers hold the measured time",
)
class ExposureTime(Law):
    """Times differ by a millisecond and by 3e-4 within pairs, and headers say so."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "rms": float(round(rng.uniform(2e-4, 2e-3), 6)),
            "relative": float(round(rng.uniform(0, 3e-4), 7)),
        }

    def _time(self, seconds, exposure):
        z = self.rng(exposure).standard_normal(2)
        return seconds * (1 + self.values["relative"] * z[0]) + self.values["rms"] * z[1]

    def seconds(self, seconds, exposure):
        return self._time(seconds, exposure) if exposure.lit else seconds

    def recorded(self, seconds, exposure):
        return round(float(self._time(seconds, exposure)), 6) if exposure.lit else seconds


@nuisance(
    "popcorn_noise",
    "Janesick 2001, section 6: random telegraph signals of the output transistor",
)
class Popcorn(Law):
    """0.3 to 3 % of the pixels, in bursts, sit 5 to 30 e- off."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "frac": float(round(rng.uniform(0.003, 0.03), 5)),
            "size": float(round(rng.uniform(5, 30), 2)),
            "length": float(round(rng.uniform(1, 6), 2)),
        }

    def noise(self, frames, exposure):
        v, out = self.values, []
        for k, f in enumerate(frames):
            rng = self.rng(exposure, k)
            bursts = rng.poisson(v["frac"] * f.size / v["length"])
            flat = np.zeros(f.size, np.float32)
            starts = rng.integers(0, f.size, bursts)
            lengths = 1 + rng.geometric(min(1.0, 1 / v["length"]), bursts) - 1
            for d in range(int(lengths.max(initial=0))):
                at = starts[lengths > d] + d
                flat[at[at < f.size]] = v["size"]
            out.append(f + flat.reshape(f.shape))
        return out


@nuisance(
    "heavy_tailed_noise",
    "Student's t of read noise, 4 to 8 degrees of freedom; skewed in some chains",
)
class HeavyTails(Law):
    """A part of the read noise has heavy tails, and a skewness."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "rms": float(round(rng.uniform(1.5, 4.0), 3)),
            "degrees": float(round(rng.uniform(3.5, 8), 2)),
            "skew": float(round(rng.uniform(0, 0.6), 3)),
        }

    def noise(self, frames, exposure):
        v, out = self.values, []
        for k, f in enumerate(frames):
            rng = self.rng(exposure, k)
            t = rng.standard_t(v["degrees"], f.shape)
            t *= np.sqrt((v["degrees"] - 2) / v["degrees"])
            e = rng.standard_exponential(f.shape) - 1
            x = np.sqrt(1 - v["skew"] ** 2) * t + v["skew"] * e
            out.append(f + (v["rms"] * x).astype(np.float32))
        return out


@nuisance(
    "tracks",
    "Particle Data Group: one muon for each cm^2 and minute at sea level; Groom 2002",
)
class SeaLevelTracks(Law):
    """Cosmic rays as at sea level, 0.7 to 3 times."""

    @classmethod
    def draw(cls, rng, setting):
        return {"factor": float(round(rng.uniform(0.7, 3), 3))}

    def extra_charge(self, charge, exposure):
        rng, d = self.rng(exposure), self.setting.nominal
        n = self.setting.layout.pixels
        area = (n * d.pixel * 1e-4) ** 2
        count = rng.poisson(
            SEA_LEVEL * self.values["factor"] * area * (exposure.seconds + 2) / 60
        )
        if not count:
            return charge
        charge = charge.copy()
        for _ in range(int(count)):
            x, y, q = straight_track(rng, n, d.thickness / d.pixel, d.pixel)
            keep = (x >= 0) & (x < n) & (y >= 0) & (y < n)
            np.add.at(charge, (y[keep].astype(int), x[keep].astype(int)), q[keep])
        return charge


def draw_nuisances(
    rng: np.random.Generator, setting: Setting, wanted: str, without: frozenset[str]
) -> list[Law]:
    """Draw nuisances.

    Parameters
    ----------
    wanted : str
        'none', 'all', 'some' (each with a chance of 0.35), or words with commas between.
    without : frozenset of str
        Words that may not be beside the campaign's laws.

    Raises
    ------
    ValueError
        A word is not known.
    """
    if wanted == "none":
        return []
    words = list(NUISANCES)
    chances = rng.random(len(words))
    if wanted == "some":
        chosen = [w for w, c in zip(words, chances, strict=True) if c < 0.35]
    elif wanted == "all":
        chosen = words
    else:
        chosen = [w.strip() for w in wanted.split(",")]
        if wrong := sorted(set(chosen) - set(words)):
            raise ValueError(f"nuisances {', '.join(wrong)}: not among {', '.join(words)}")
    out: list[Law] = []
    for word in words:
        # each is drawn from a stream of its own, so that switching one off leaves the others
        own = np.random.default_rng([setting.seed, 555, words.index(word)])
        values: dict[str, Any] = NUISANCES[word].draw(own, setting)
        if word in chosen and word not in without:
            out.append(NUISANCES[word](values=values))
    return out
