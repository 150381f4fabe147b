"""Effects for the tests of sensors: laws written down here, and what reports hold."""

from __future__ import annotations

import json

import galsim
import numpy as np

from bfsensor import BrighterFatterSensor
from bfsensor.effects.effect import Effect, Law, Parameter


class Ratio(Effect):
    word, stage = "bf_anisotropy", "collect"
    parameters = (Parameter("eps", "", 0.02, 0.3, signed=True, amplitude=True),)

    def edges(self, kx, ky, shot, layout):
        return (1 - self["eps"] / 2) * kx, (1 + self["eps"] / 2) * ky


class Coloured(Effect):
    word, stage = "bf_chromatic", "collect"
    parameters = (Parameter("kappa", "", 0.01, 0.2, signed=True, amplitude=True),)

    def edges(self, kx, ky, shot, layout):
        factor = 1 + self["kappa"] * (shot.wavelength - 620) / 330
        return factor * kx, factor * ky


class Tail(Effect):
    """Shifts of edges, one by one at random, besides those that are there."""

    word, stage = "bf_long_range", "collect"
    parameters = (Parameter("amp", "1/e-", 1e-9, 1e-7, amplitude=True),)

    def edges(self, kx, ky, shot, layout):
        more = np.pad(
            np.random.default_rng(909).normal(size=(2, 13, 13)), ((0, 0), (2, 2), (2, 2))
        )
        margin = (17 - len(kx)) // 2
        return tuple(
            np.pad(k, margin) + self["amp"] * m for k, m in zip((kx, ky), more, strict=True)
        )


class Rough(Effect):
    """Standing displacements without any order."""

    word, stage = "mask_stitch", "collect"
    parameters = (Parameter("amp", "pixel", 1e-4, 1e-2, amplitude=True),)

    def displacements(self, shot, layout):
        rng = np.random.default_rng(33)
        ny, nx = layout.shape
        return (
            self["amp"] * rng.normal(size=(ny, nx + 1)),
            self["amp"] * rng.normal(size=(ny + 1, nx)),
        )


class Bent(Effect):
    word, stage = "bf_nonlinear", "collect"
    parameters = (Parameter("b", "1/e-", 3e-7, 3e-6, signed=True, amplitude=True),)

    def law(self):
        return Law(bend=self["b"])


class Full(Effect):
    word, stage = "saturation", "collect"
    parameters = (Parameter("full_well", "e-", 7e4, 1e5, neutral=2e5, amplitude=True),)

    def law(self):
        return Law(full_well=self["full_well"])


class Wide(Effect):
    word, stage = "lateral_diffusion", "light"
    parameters = (
        Parameter("var", "pixel^2", 0.005, 0.2, amplitude=True),
        Parameter("frac", "", 1e-3, 0.05, amplitude=True),
    )

    def spot_light(self, shot, layout):
        return self["var"], ((self["frac"], 5.0),)


class Shade(Effect):
    """Less light on the left, more on the right."""

    word, stage = "shutter_timing", "light"
    parameters = (Parameter("dt", "s", 5e-3, 5e-2, signed=True, amplitude=True),)

    def light_map(self, shot, layout):
        ny, nx = layout.shape
        side = np.where(np.arange(nx) < nx // 2, -1.0, 1.0)
        return np.ones((ny, 1)) * (1 + self["dt"] * side / shot.seconds)


class Warm(Effect):
    word, stage = "dark_hot", "store"
    parameters = (Parameter("rate", "e-/s", 0.02, 1.0, amplitude=True),)

    def store(self, charge, shot, layout, rng, memory):
        return charge + rng.poisson(self["rate"] * shot.seconds, charge.shape)


class Ghost(Effect):
    word, stage = "persistence", "store"
    parameters = (Parameter("frac", "", 1e-5, 1e-3, amplitude=True),)

    def store(self, charge, shot, layout, rng, memory):
        left = memory.get(self.word, 0.0)
        memory[self.word] = self["frac"] * charge
        return charge + left


LAYOUT = {"shape": (21, 21)}
PLAIN = {"charge_response": False, "background": False, "depth": False}
"""The table's response to a small charge on nothing, from the back surface."""

REPORTED = {
    "charge_loss": {"q": 1e-7},
    "interpixel_coupling": {"ax": 0.02, "ay": 0.01},
    "tearing": {"amp": 0.1, "length": 2.0, "column": 0.5, "open": 1.0},
    "trap_serial": {"size": 40.0, "tau": 1.5, "amp": 0.0, "reach": 50.0},
}


def entry(word, **changes):
    values = {**REPORTED.get(word, {}), **changes}
    return {"class": word, "parameters": {n: {"value": v} for n, v in values.items()}}


def write_report(path, entries, **changes):
    report = {
        "schema": "bfsensor-diagnosis-1",
        "detected": True,
        "effects": entries,
        **changes,
    }
    path.write_text(json.dumps(report))
    return str(path)


def sensor_with(*effects, **options):
    return BrighterFatterSensor(
        rng=galsim.BaseDeviate(6007), effects=list(effects) or None, **options
    )


def areas_of(sensor, charges, center=None):
    image = galsim.ImageD(np.array(charges, float))
    center = galsim.PositionI(0, 0) if center is None else center
    return sensor.calculate_pixel_areas(image, center).array


def flat_photons(shape, count, seed):
    rng = np.random.default_rng(seed)
    ny, nx = shape
    x, y = rng.uniform(0.5, nx + 0.5, count), rng.uniform(0.5, ny + 0.5, count)
    return galsim.PhotonArray(count, x, y, np.ones(count))


def single(charge, side=21):
    image = np.zeros((side, side))
    image[side // 2, side // 2] = charge
    return image
