"""Effects of the device: fields, pixel edges, collected and stored charge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from validation.concealed.card import NOMINAL, SPREAD
from validation.concealed.effect import Effect, Range
from validation.concealed.electrostatics import EdgeShifts
from validation.concealed.plan import Exposure
from validation.concealed.scene import diffusion_variance


def _scaled(shifts, x, y=None):
    return EdgeShifts(shifts.kx * x, shifts.ky * (x if y is None else y))


def _edges(pixels):
    """Places of all edges across one axis; pixel centres are whole numbers from zero."""
    return np.arange(pixels + 1) - 0.5


def _images(x, y, pixels):
    shapes = (pixels, pixels + 1), (pixels + 1, pixels)
    return tuple(
        np.array(np.broadcast_to(d, shape), np.float32)
        for d, shape in zip((x, y), shapes, strict=True)
    )


@dataclass(frozen=True)
class InterpixelCoupling(Effect):
    """Each pixel gives ``ax`` to either neighbour in the row and ``ay`` in the column."""

    word = "interpixel_coupling"
    variants = {
        "": {
            "ax": Range(3e-4, 3e-3, amplitude=True),
            "ay": Range(3e-4, 3e-3, amplitude=True),
        }
    }

    def store(self, charge, context):
        out = charge
        for axis, alpha in ((1, self.parameters["ax"]), (0, self.parameters["ay"])):
            given = np.roll(charge, 1, axis) + np.roll(charge, -1, axis) - 2 * charge
            out = out + np.float32(alpha) * given
        return out


@dataclass(frozen=True)
class Nonlinear(Effect):
    """Edges move by k Q (1 + b Q / 2), ``b`` per electron."""

    word = "bf_nonlinear"
    variants = {"": {"b": Range(3e-7, 3e-6, signed=True, amplitude=True)}}

    def laws(self, context):
        return {"curvature": self.parameters["b"]}


@dataclass(frozen=True)
class Chromatic(Effect):
    """Shifts change by ``kappa`` per 330 nm from 620 nm, beside what the card gives."""

    word = "bf_chromatic"
    variants = {"": {"kappa": Range(0.01, 0.2, signed=True, amplitude=True)}}

    def shifts(self, shifts, context):
        steps = (context.exposure.wavelength - 620.0) / 330.0
        return _scaled(shifts, 1 + self.parameters["kappa"] * steps)


@dataclass(frozen=True)
class Anisotropy(Effect):
    """Shifts in x times (1 - eps / 2), in y times (1 + eps / 2)."""

    word = "bf_anisotropy"
    variants = {"": {"eps": Range(0.02, 0.3, signed=True, amplitude=True)}}

    def shifts(self, shifts, context):
        eps = self.parameters["eps"]
        return _scaled(shifts, 1 - eps / 2, 1 + eps / 2)


@dataclass(frozen=True)
class LongRange(Effect):
    """Area changes ``amp`` / r^power besides (1/e-, r in pixels), charge conserved.

    To 30 pixels (or half the sensor); edges follow from a potential on the lattice.
    """

    word = "bf_long_range"
    variants = {
        "": {"amp": Range(5e-9, 1e-7, amplitude=True), "power": Range(1.7, 2.5, "flat")}
    }

    def shifts(self, shifts, context):
        half = min(30, context.geometry.pixels // 2 - 2)
        side = np.arange(-half, half + 1)
        r = np.hypot(side[None, :], side[:, None])
        area = np.where(r > 0, np.maximum(r, 1) ** -self.parameters["power"], 0.0)
        area[half, half] = -area.sum()
        # div grad potential = area on a lattice twice as wide, so that it closes far outside
        wide = 4 * half + 4
        origin = np.zeros((wide, wide))
        origin[: 2 * half + 1, : 2 * half + 1] = area
        wave = 2 * np.sin(np.pi * np.fft.fftfreq(wide))
        laplacian = -(wave[:, None] ** 2 + wave[None, :] ** 2)
        laplacian[0, 0] = 1
        potential = np.fft.ifft2(np.fft.fft2(origin) / laplacian).real
        keep = (slice(2 * half + 1),) * 2
        kx, ky = ((np.roll(potential, -1, a) - potential)[keep] for a in (1, 0))
        out = []
        for old, new in ((shifts.kx, kx), (shifts.ky, ky)):
            grown = self.parameters["amp"] * new
            inner = old.shape[0] // 2
            centre = slice(half - inner, half + inner + 1)
            grown[centre, centre] += old
            out.append(grown)
        return EdgeShifts(*out)


_SIGMAS = {"thickness": 8, "h": 5, "wx": 8, "wy": 8, "zx": 6, "zy": 6, "doping": 6}


@dataclass(frozen=True)
class DeviceParameter(Effect):
    """A parameter of the card far off: named by the variant, its true value told.

    Drawn as a distance from nominal of 0.6 to 1.6 times the number of spreads in _SIGMAS.
    """

    word = "device_parameter"
    variants = {
        name: {name: Range(0.6 * n * SPREAD[name], 1.6 * n * SPREAD[name], signed=True)}
        for name, n in _SIGMAS.items()
    }

    @classmethod
    def draw(cls, rng, strength=None, variant=None):
        names = sorted(cls.variants)
        name = names[rng.integers(len(names))] if variant is None else variant
        if name not in cls.variants:
            raise ValueError(f"{cls.word}: variant = {name!r}, one of {names}")
        place = rng.random() if strength is None else strength
        away = _SIGMAS[name] * SPREAD[name] * (0.6 + place)
        if name in ("zy", "h", "wx", "doping"):
            # up only where down would cross a plate, the charge or depletion
            sign = 1.0 if name != "h" else -1.0
        else:
            sign = rng.choice([-1.0, 1.0])
        return cls({name: float(NOMINAL[name] + sign * away)}, name)

    def neutral(self):
        return type(self)({self.variant: NOMINAL[self.variant]}, self.variant)

    def scaled(self, factor):
        nominal = NOMINAL[self.variant]
        value = nominal + factor * (self.parameters[self.variant] - nominal)
        return type(self)({self.variant: value}, self.variant)

    def device(self, device):
        # the told value is the true one: no scatter on top
        value = self.parameters[self.variant]
        return device if value == NOMINAL[self.variant] else {**device, self.variant: value}

    def truth(self):
        return {"class": self.word, "parameters": dict(self.parameters)}


@dataclass(frozen=True)
class VoltageDependence(Effect):
    """Shifts change by ``delta`` per 20 V of less back bias than nominal."""

    word = "voltage_dependence"
    variants = {"": {"delta": Range(0.02, 0.3, signed=True, amplitude=True)}}

    def shifts(self, shifts, context):
        steps = (context.exposure.back_bias - NOMINAL["vbb"]) / 20.0
        return _scaled(shifts, 1 + self.parameters["delta"] * steps)


@dataclass(frozen=True)
class LateralDiffusion(Effect):
    """Spots widen by ``var`` pixel^2 at 620 nm, nominal bias and -100 C.

    Elsewhere in proportion to kT, the drift path from where light converts, and one over the
    voltage: a width that is the same at all conditions could not be told from the optics.
    """

    word = "lateral_diffusion"
    variants = {"": {"var": Range(0.005, 0.2, amplitude=True)}}

    def spot_light(self, context):
        here = diffusion_variance(context.exposure, context.device)
        usual = diffusion_variance(Exposure("SPOT", 0, 0.0, 0.0), context.device)
        return {"variance": self.parameters["var"] * here / usual}


@dataclass(frozen=True)
class TreeRings(Effect):
    """Edges stand off by ``amp`` sin(2 pi r / period) along the radius from (xc, yc).

    ``chirp``: relative change of the rings' frequency per 100 pixels of radius.
    """

    word = "tree_rings"
    variants = {
        "": {
            "amp": Range(1e-3, 0.05, amplitude=True),
            "period": Range(12.0, 60.0),
            "xc": Range(-150.0, -40.0, "flat"),
            "yc": Range(280.0, 450.0, "flat"),
            "chirp": Range(-0.05, 0.05, "flat"),
        }
    }

    def displaced(self, context):
        n = context.geometry.pixels
        centre = np.arange(n, dtype=float)
        p = self.parameters
        start = np.hypot(p["xc"], p["yc"])

        def along(px, py):
            dx, dy = px - p["xc"], py - p["yc"]
            r = np.hypot(dx, dy)
            turns = r / p["period"] * (1 + p["chirp"] * (r - start) / 200.0)
            return p["amp"] * np.sin(2 * np.pi * turns), dx / r, dy / r

        column_edge, cosine, _ = along(_edges(n)[None, :], centre[:, None])
        row_edge, _, sine = along(centre[None, :], _edges(n)[:, None])
        return _images(column_edge * cosine, row_edge * sine, n)


@dataclass(frozen=True)
class EdgeRolloff(Effect):
    """Pixel edges near the rim stand outwards by ``amp`` exp(-d / length) pixels."""

    word = "edge_rolloff"
    variants = {"": {"amp": Range(0.01, 0.5, amplitude=True), "length": Range(1.5, 8.0)}}

    def displaced(self, context):
        n = context.geometry.pixels
        edge = np.arange(n + 1)
        amp, length = self.parameters["amp"], self.parameters["length"]
        out = amp * (np.exp(-(n - edge) / length) - np.exp(-edge / length))
        return _images(out[None, :], out[:, None], n)


@dataclass(frozen=True)
class MaskStitch(Effect):
    """Every ``period``-th boundary between columns is displaced by ``amp`` pixels."""

    word = "mask_stitch"
    variants = {
        "": {
            "amp": Range(5e-4, 1e-2, signed=True, amplitude=True),
            "period": Range(16, 64, "whole"),
        }
    }

    def displaced(self, context):
        n, period = context.geometry.pixels, int(self.parameters["period"])
        edge = np.arange(n + 1)
        moved = (edge % period == 0) & (edge > 0) & (edge < n)
        return _images(moved[None, :] * self.parameters["amp"], np.zeros((1, 1)), n)


@dataclass(frozen=True)
class Tearing(Effect):
    """Edges by one column boundary are displaced by ``amp`` exp(-d / length) pixels.

    Above a row that moves with every exposure the tear is closed.
    """

    word = "tearing"
    variants = {
        "": {
            "amp": Range(3e-3, 0.2, signed=True, amplitude=True),
            "length": Range(1.0, 5.0),
            "column": Range(0.2, 0.8, "flat"),
        }
    }

    def displaced(self, context):
        n = context.geometry.pixels
        closed = context.stream(self.word).uniform(0.4, 1.0) * n
        boundary = round(self.parameters["column"] * n)
        fall = np.exp(-np.abs(np.arange(n + 1) - boundary) / self.parameters["length"])
        torn = self.parameters["amp"] * fall[None, :] * (np.arange(n) < closed)[:, None]
        return _images(torn, np.zeros((1, 1)), n)


@dataclass(frozen=True)
class ChargeLoss(Effect):
    """Light is collected with exp(-q Q), Q the charge already there."""

    word = "charge_loss"
    variants = {"": {"q": Range(1e-8, 3e-7, amplitude=True)}}

    def laws(self, context):
        return {"loss": self.parameters["q"]}


@dataclass(frozen=True)
class Persistence(Effect):
    """``frac`` exp(-k / tau) of a charge shows again in the k-th exposure after it."""

    word = "persistence"
    variants = {"": {"frac": Range(1e-5, 1e-3, amplitude=True), "tau": Range(0.7, 5.0)}}

    def store(self, charge, context):
        frac, tau = np.float32(self.parameters["frac"]), self.parameters["tau"]
        left = context.memory.get(self.word)
        stored = charge
        if left is not None and frac:
            charge = charge + context.stream(self.word).poisson(left).astype(np.float32)
        old = 0 if left is None else left
        context.memory[self.word] = np.float32(np.exp(-1 / tau)) * (old + frac * stored)
        return charge


@dataclass(frozen=True)
class Saturation(Effect):
    """Charge beyond ``full_well`` e- spills along the column, far below the nominal 2e5."""

    word = "saturation"
    variants = {"": {"full_well": Range(7e4, 1.15e5, "flat")}}

    @classmethod
    def draw(cls, rng, strength=None, variant=None):
        drawn = super().draw(rng, strength, variant)
        if strength is not None:
            return cls({"full_well": 1.15e5 - 4.5e4 * strength})
        return drawn

    def neutral(self):
        return type(self)({"full_well": 2e5})

    def scaled(self, factor):
        return type(self)(
            {"full_well": 2e5 - factor * (2e5 - self.parameters["full_well"])}
        )

    def laws(self, context):
        return {"full_well": self.parameters["full_well"]}


SILICON_EFFECTS = (
    InterpixelCoupling,
    Nonlinear,
    Chromatic,
    Anisotropy,
    LongRange,
    DeviceParameter,
    VoltageDependence,
    LateralDiffusion,
    TreeRings,
    EdgeRolloff,
    MaskStitch,
    Tearing,
    ChargeLoss,
    Persistence,
    Saturation,
)
