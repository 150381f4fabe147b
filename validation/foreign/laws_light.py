"""Laws of light and charge beside it: turbulence, fringes, wings, shutter, dark, tracks, persistence."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft2, rfft2

from validation.foreign.collection import poisson
from validation.foreign.device import absorption_length
from validation.foreign.law import Law, law
from validation.foreign.laws_silicon import either_sign


def random_field(rng, shape, spectrum):
    """A periodic random field of unit rms with a given power at each wave number [1/pixel]."""
    ky = np.fft.fftfreq(shape[0])[:, None]
    kx = np.fft.rfftfreq(shape[1])
    k = np.hypot(kx, ky)
    amplitude = np.sqrt(spectrum(np.maximum(k, 1e-9)))
    amplitude[0, 0] = 0.0
    field = irfft2(rfft2(rng.standard_normal(shape)) * amplitude, s=shape)
    return (field / field.std()).astype(np.float32)


# -------------------------------------------------------------------- illumination
@law(
    "illumination_turbulence",
    "kolmogorov",
    amplitude="rms",
    start=0.0004,
    limits=(5e-06, 0.03),
    power=1.8,
    source="Banovetz et al. 2024 (arXiv 2411.13386, JATIS): 'weather' in "
    "differenced flats; Kolmogorov 1941: power k^(-11/3) above the outer "
    "scale",
)
class Kolmogorov(Law):
    """Each flat is multiplied by 1 + rms x, x a field with power (k^2 + 1/length^2)^(-11/6)."""

    @classmethod
    def draw(cls, rng, setting):
        return {"length": float(round(rng.uniform(0.15, 0.8) * setting.layout.pixels, 1))}

    def field(self, exposure):
        low = 1 / self.values["length"] ** 2
        return random_field(
            self.rng(exposure), self.setting.shape, lambda k: (k**2 + low) ** (-11 / 6)
        )

    def light(self, light, exposure):
        if exposure.kind != "FLAT":
            return light
        return light.scaled(1 + np.float32(self.values["rms"]) * self.field(exposure))


@law(
    "illumination_turbulence",
    "drifting_cells",
    amplitude="rms",
    start=0.0004,
    limits=(5e-06, 0.03),
    power=1.8,
    source="Banovetz et al. 2024: warm air of the projector; cells of one size "
    "that move on and live for several exposures",
)
class DriftingCells(Kolmogorov):
    """Gaussian cells of one length; a share ``memory`` of the field lives on to the next exposure."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "length": float(round(rng.uniform(0.05, 0.25) * setting.layout.pixels, 1)),
            "memory": float(round(rng.uniform(0.0, 0.6), 3)),
        }

    def field(self, exposure):
        length, memory = self.values["length"], self.values["memory"]
        out = np.zeros(self.setting.shape, np.float32)
        # a finite sum of older fields needs no order in which exposures are taken
        for back in range(6):
            weight = memory**back
            if weight < 0.02 or back > exposure.sequence:
                break
            fresh = random_field(
                np.random.default_rng([self.setting.seed, 991, exposure.sequence - back]),
                self.setting.shape,
                lambda k: np.exp(-((2 * np.pi * k * length) ** 2) / 2),
            )
            out += np.float32(weight) * fresh
        return out * np.float32(np.sqrt(1 - memory**2))


class _Fringes(Law):
    index = 3.65
    """Refraction of silicon near 950 nm at 173 K (Green 2008, 3.6 to 3.7)."""

    def height(self):
        raise NotImplementedError

    def light(self, light, exposure):
        if exposure.wavelength < 780:
            return light
        if "height" not in self.state:
            self.state["height"] = self.height()
        d, t = self.state["height"], self.setting.nominal.thickness
        # light that returns from the gates has crossed the silicon twice
        back = np.exp(-2 * t / absorption_length(exposure.wavelength))
        full = np.exp(-2 * t / absorption_length(950))
        phase = 4 * np.pi * self.index * d * 1e3 / exposure.wavelength
        amp = self.values["amp"] * back / full
        return light.scaled((1 + amp * np.cos(phase)).astype(np.float32))


@law(
    "fringing",
    "wedge",
    amplitude="amp",
    start=0.003,
    limits=(2e-05, 0.2),
    needs=("red",),
    source="Malumuth et al. 2003 (SPIE 4854, 567): amp cos(4 pi n d / lambda), d a"
    " bowl and a wedge",
)
class FringesWedge(_Fringes):
    """Thickness is a wedge and a bowl of some wavelengths; amp at 950 nm, weaker to the blue."""

    @classmethod
    def draw(cls, rng, setting):
        wedge, bowl = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.2, 1.0)
        return {"wedge": [float(round(w, 4)) for w in wedge], "bowl": float(round(bowl, 4))}

    def height(self):
        n = self.setting.layout.pixels
        y, x = np.mgrid[0:n, 0:n] / n - 0.5
        a, b = self.values["wedge"]
        return a * x + b * y + self.values["bowl"] * (x * x + y * y)


@law(
    "fringing",
    "rough_layers",
    amplitude="amp",
    start=0.003,
    limits=(2e-05, 0.2),
    needs=("red",),
    source="Guo et al. 2023 (PASP 135, 034503, fringing of LSST sensors): random "
    "thickness with a red spectrum, and a second epoxy layer's fringes",
)
class FringesRough(_Fringes):
    """Thickness is a random field of ``rough`` um rms with power k^-4."""

    @classmethod
    def draw(cls, rng, setting):
        return {"rough": float(round(rng.uniform(0.08, 0.3), 4))}

    def height(self):
        return self.values["rough"] * random_field(
            self.rng(), self.setting.shape, lambda k: (k**2 + 1e-4) ** -2.0
        )


class _Wings(Law):
    def halo(self, r):
        raise NotImplementedError

    def light(self, light, exposure):
        frac = self.values["frac"]
        if exposure.kind != "SPOT" or not frac:
            return light
        n = self.setting.layout.pixels
        if "halo" not in self.state:
            at = np.minimum(np.arange(n), n - np.arange(n))
            halo = self.halo(np.hypot(at[:, None], at))
            self.state["halo"] = rfft2(halo / halo.sum()).astype(np.complex64)
        wings = irfft2(rfft2(light.rate) * self.state["halo"], s=light.rate.shape)
        core = light.scaled(np.full_like(light.rate, 1 - frac))
        return core.plus(frac * wings)


@law(
    "psf_wings",
    "king",
    amplitude="frac",
    start=0.003,
    limits=(1e-05, 0.2),
    needs=("spots",),
    source="King 1971 (PASP 83, 199): aureole as r^-2; Racine 1996 (PASP 108, 699)",
)
class WingsKing(_Wings):
    """A fraction of a spot's light lies in a halo 1 / (length^2 + r^2)."""

    @classmethod
    def draw(cls, rng, setting):
        return {"length": float(round(rng.uniform(2.0, 8.0), 3))}

    def halo(self, r):
        return 1 / (self.values["length"] ** 2 + r**2)


@law(
    "psf_wings",
    "exponential",
    amplitude="frac",
    start=0.003,
    limits=(1e-05, 0.2),
    needs=("spots",),
    source="Sirianni et al. 2005 (PASP 117, 1049, long-wavelength halo of thinned "
    "CCDs): exponential halo that grows to the red",
)
class WingsExponential(_Wings):
    """A fraction of the light lies in a halo exp(-r / length)."""

    @classmethod
    def draw(cls, rng, setting):
        return {"length": float(round(rng.uniform(2.5, 10.0), 3))}

    def halo(self, r):
        return np.exp(-r / self.values["length"])


# -------------------------------------------------------------------- shutter
class _Shutter(Law):
    def shade(self, x, y):
        """Part of dt that each place gets, 1 on average over the sensor."""
        raise NotImplementedError

    def seconds(self, seconds, exposure):
        if not exposure.lit:
            return seconds
        if "shade" not in self.state:
            n = self.setting.layout.pixels
            y, x = np.mgrid[0:n, 0:n] / n - 0.5
            self.state["shade"] = self.shade(x, y)
        map_ = self.state["shade"]
        if np.isscalar(map_):
            return np.maximum(seconds + self.values["dt"] * map_, 0.0)
        return np.maximum(seconds + np.float32(self.values["dt"]) * map_, 0).astype(
            np.float32
        )


@law(
    "shutter_timing",
    "offset",
    amplitude="dt",
    start=0.006,
    limits=(2e-05, 0.5),
    beside=("exposure_time",),
    source="Stetson 1989 (dome-flat shutter tests): t + dt everywhere",
)
class ShutterOffset(_Shutter):
    """All exposures are longer by dt."""

    draw = classmethod(lambda cls, rng, setting: either_sign(rng))

    def shade(self, x, y):
        return 1.0


@law(
    "shutter_timing",
    "iris",
    amplitude="dt",
    start=0.004,
    limits=(5e-05, 0.5),
    beside=("exposure_time",),
    source="Zissell 2000 (JAAVSO 28, 149, shutter mapping): an iris opens from the"
    " middle, dt (1 - r^2 / R^2)",
)
class ShutterIris(_Shutter):
    """The middle is exposed longest: dt (1 - shading r^2 / R^2), normed to 1 on average."""

    @classmethod
    def draw(cls, rng, setting):
        return {**either_sign(rng), "shading": float(round(rng.uniform(0.3, 1.5), 3))}

    def shade(self, x, y):
        s = 1 - self.values["shading"] * (x * x + y * y) / 0.5
        return (s / s.mean()).astype(np.float32)


@law(
    "shutter_timing",
    "blade",
    amplitude="dt",
    start=0.0035,
    limits=(5e-05, 0.5),
    beside=("exposure_time",),
    source="Reif et al. 2005 (Bonn shutter, Scientific Detectors for Astronomy): "
    "blades of unequal speed, dt linear along the travel",
)
class ShutterBlade(ShutterIris):
    """dt (1 + shading y) along the blades' way."""

    @classmethod
    def draw(cls, rng, setting):
        value = rng.choice([-1, 1]) * rng.uniform(0.5, 3.0)
        return {**either_sign(rng), "shading": float(round(value, 3))}

    def shade(self, x, y):
        return (1 + self.values["shading"] * y).astype(np.float32)


# -------------------------------------------------------------------- dark charge
class _Dark(Law):
    def rate(self):
        """Map of dark current for rate 1 [e-/s]."""
        raise NotImplementedError

    def warmth(self, exposure) -> float:
        """Dark current doubles for each 7 K (Janesick 2001, section 7.1, near 173 K)."""
        return 2 ** ((exposure.temperature + 100) / 7.0)

    def extra_charge(self, charge, exposure):
        if not exposure.seconds or not self.values["rate"]:
            return charge
        if "rate" not in self.state:
            self.state["rate"] = self.rate()
        mean = (
            self.values["rate"]
            * self.state["rate"]
            * exposure.seconds
            * self.warmth(exposure)
        )
        more = self.rng(exposure).poisson(mean).astype(np.float32)
        return charge + more


@law(
    "dark_hot",
    "uniform",
    amplitude="rate",
    start=0.03,
    limits=(0.001, 60.0),
    beside=("hot_pixel",),
    source="Janesick 2001, section 7.1: dark current, twice as large every 7 K",
)
class DarkUniform(_Dark):
    """Dark current of ``rate`` e-/s in all pixels."""

    def rate(self):
        return np.ones(self.setting.shape)


@law(
    "dark_hot",
    "hot_columns",
    amplitude="rate",
    start=0.2,
    limits=(0.02, 2000.0),
    beside=("hot_pixel", "bad_column"),
    source="Widenhorn et al. 2002 (SPIE 4669): generation at single sites; columns"
    " fed from a site's row up",
)
class DarkColumns(_Dark):
    """Some columns are hot from a row on, the first with ``rate`` e-/s, others less."""

    @classmethod
    def draw(cls, rng, setting):
        n, count = setting.layout.pixels, int(rng.integers(1, 7))
        return {
            "columns": [int(c) for c in rng.choice(n, count, replace=False)],
            "rows": [int(r) for r in rng.integers(0, n // 2, count)],
            "weights": [
                1.0,
                *[float(round(w, 3)) for w in rng.uniform(0.1, 0.9, count - 1)],
            ],
        }

    def rate(self):
        out, v = np.zeros(self.setting.shape), self.values
        for c, r, w in zip(v["columns"], v["rows"], v["weights"], strict=True):
            out[r:, c] += w
        return out


@law(
    "dark_hot",
    "glow",
    amplitude="rate",
    start=0.12,
    limits=(0.01, 400.0),
    beside=("hot_pixel",),
    source="Janesick 2001, section 7.2: glow of an output amplifier falls with "
    "distance from its corner; here exp(-r / length)",
)
class DarkGlow(_Dark):
    """Glow from one corner, ``rate`` e-/s there; as strong at all temperatures."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "length": float(round(rng.uniform(0.08, 0.4) * setting.layout.pixels, 1)),
            "corner": [int(c) for c in rng.integers(0, 2, 2)],
        }

    def warmth(self, exposure):
        return 1.0

    def rate(self):
        n = self.setting.layout.pixels
        y, x = np.mgrid[0:n, 0:n]
        cx, cy = (c * (n - 1) for c in self.values["corner"])
        return np.exp(-np.hypot(x - cx, y - cy) / self.values["length"])


# -------------------------------------------------------------------- particles
class _Tracks(Law):
    def one(self, rng, n):
        """Points x, y [pixel] and electrons of one track."""
        raise NotImplementedError

    def extra_charge(self, charge, exposure):
        rng = self.rng(exposure)
        n = self.setting.layout.pixels
        # exposed also while it is read out
        minutes = (exposure.seconds + 2.0) / 60.0
        mean = self.values["rate"] * minutes * (n / 256) ** 2
        count = rng.poisson(mean)
        if not count:
            return charge
        charge = charge.copy()
        for _ in range(min(int(count), 5000)):
            x, y, q = self.one(rng, n)
            keep = (x >= 0) & (x < n) & (y >= 0) & (y < n)
            np.add.at(charge, (y[keep].astype(int), x[keep].astype(int)), q[keep])
        return charge


ELECTRONS_PER_UM = 80.0
"""Most probable charge of a minimum-ionising particle in silicon [e-/um] (PDG, Bichsel 1988)."""


def straight_track(rng, n, thickness_px, pixel_um, steps=4):
    """A straight track through the silicon, angles as cos^2 of the zenith, Landau-like charge."""
    zenith = np.arccos(np.clip(rng.random() ** (1 / 3), 0.02, 1))
    azimuth = rng.uniform(0, 2 * np.pi)
    length = min(thickness_px * np.tan(zenith), 3.0 * n)
    count = max(int(length * steps), steps)
    s = (np.arange(count) + 0.5) / count * length
    x = rng.uniform(0, n) + s * np.cos(azimuth)
    y = rng.uniform(0, n) + s * np.sin(azimuth)
    um = np.hypot(length, thickness_px) * pixel_um
    landau = 1 + 0.1 * rng.exponential(1, count) + 0.3 * (rng.random(count) < 0.02)
    return x, y, (ELECTRONS_PER_UM * um / count * landau).astype(np.float32)


@law(
    "cosmic_rays",
    "muons",
    amplitude="rate",
    start=8,
    limits=(0.3, 400.0),
    beside=("tracks",),
    source="Groom 2002 (Exp. Astron. 14, 45): muons, straight tracks, 80 e-/um, "
    "zenith angles as cos^2",
)
class Muons(_Tracks):
    """Straight tracks, ``rate`` for each minute and 256 x 256 pixels."""

    def one(self, rng, n):
        d = self.setting.nominal
        return straight_track(rng, n, d.thickness / d.pixel, d.pixel)


@law(
    "cosmic_rays",
    "worms",
    amplitude="rate",
    start=12,
    limits=(0.3, 400.0),
    beside=("tracks",),
    source="Groom 2002: low-energy electrons of Compton scattering, multiple-"
    "scattered 'worms', and dots of X rays",
)
class Worms(_Tracks):
    """Wandering tracks that thicken to their end, and dots of a few thousand electrons."""

    def one(self, rng, n):
        x0, y0 = rng.uniform(0, n, 2)
        if rng.random() < 0.3:
            return (
                np.array([x0]),
                np.array([y0]),
                np.array([rng.uniform(300, 6000)], np.float32),
            )
        count = int(rng.integers(6, 60))
        turn = np.cumsum(rng.normal(0, 0.55, count)) + rng.uniform(0, 2 * np.pi)
        x, y = x0 + np.cumsum(0.5 * np.cos(turn)), y0 + np.cumsum(0.5 * np.sin(turn))
        um = 0.5 * self.setting.nominal.pixel
        rise = 1 + 2 * np.exp(-np.arange(count)[::-1] / 4)
        return (
            x,
            y,
            (ELECTRONS_PER_UM * um * rise * rng.gamma(6, 1 / 6, count)).astype(np.float32),
        )


# -------------------------------------------------------------------- persistence
class _Persistence(Law):
    """Traps fill from an exposure and release over the next ones; charge is conserved."""

    def shares(self, age):
        """What is released in the age-th exposure after, over that in the first."""
        raise NotImplementedError

    ages = 30

    def captured(self, charge):
        """Charge that is seen in the first exposure after."""
        return np.float32(self.values["frac"]) * charge

    def remember(self, charge, exposure):
        if not self.values["frac"]:
            return charge
        past = self.state.setdefault("past", [])
        out = charge.copy()
        released = np.zeros_like(charge)
        for sequence, left in past:
            age = exposure.sequence - sequence
            if 1 <= age <= self.ages:
                released += np.float32(self.shares(age)) * left
        # Each electron is released at random.
        out += poisson(np.maximum(released, 0), self.rng(exposure))
        self.state["past"] = [(s, q) for s, q in past if exposure.sequence - s < self.ages]
        if exposure.lit:
            first = self.captured(charge)
            total = sum(self.shares(a) for a in range(1, self.ages + 1))
            out -= np.float32(total) * first
            self.state["past"].append((exposure.sequence, first))
        return out


@law(
    "persistence",
    "one_exponential",
    amplitude="frac",
    start=1e-05,
    limits=(1e-07, 0.02),
    source="Janesick 2001, section 2.4 (residual images): one trap, exp(-n / tau)",
)
class PersistenceOne(_Persistence):
    """frac of the charge comes in the next exposure, less by exp(-1/tau) in each one after."""

    @classmethod
    def draw(cls, rng, setting):
        return {"tau": float(round(rng.uniform(0.6, 4.0), 3))}

    def shares(self, age):
        return np.exp(-(age - 1) / self.values["tau"])


@law(
    "persistence",
    "two_exponentials",
    amplitude="frac",
    start=1.5e-05,
    limits=(1e-07, 0.02),
    source="Polin et al. 2025 (JINST 20, P07031): two causes in e2v sensors, and "
    "only above a level",
)
class PersistenceTwo(PersistenceOne):
    """Two times, the second with a share; only charge above a threshold is kept."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            "tau": float(round(rng.uniform(0.4, 1.2), 3)),
            "tau2": float(round(rng.uniform(3.0, 9.0), 3)),
            "share2": float(round(rng.uniform(0.1, 0.6), 3)),
            "threshold": float(round(rng.uniform(0, 4e4))),
        }

    def captured(self, charge):
        return np.float32(self.values["frac"]) * np.maximum(
            charge - self.values["threshold"], 0
        )

    def shares(self, age):
        v = self.values
        slow = v["share2"] * np.exp(-(age - 1) / v["tau2"])
        return (1 - v["share2"]) * np.exp(-(age - 1) / v["tau"]) + slow


@law(
    "persistence",
    "power_law",
    amplitude="frac",
    start=1.5e-05,
    limits=(1e-07, 0.02),
    source="Smith et al. 2008 (SPIE 7021, 70210J, theory of image persistence): a "
    "range of time constants makes a power law of time, age^-exponent",
)
class PersistencePower(_Persistence):
    """frac / age^exponent in the age-th exposure after."""

    @classmethod
    def draw(cls, rng, setting):
        return {"exponent": float(round(rng.uniform(0.8, 1.6), 3))}

    def shares(self, age):
        return age ** -self.values["exponent"]
