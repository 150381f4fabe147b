"""The test bench: one exposure from lamp to codes, through the laws that are in it.

What is always there, in nulls too: a real device scattered about its card, gains scattered by
3 %, read noise by 4 %, offsets of the amplifiers, row noise of 0.05 e-, pixel response of
0.3 %, a gradient of the illumination of 1 %, a lamp that walks by 2e-4 for each exposure and a
monitor that errs by 2e-4, dark current of 0.01 e-/s, spots whose fluxes scatter by 2 % and whose
widths differ by 2 % between x and y, at random dithers.

Random numbers come from streams keyed by campaign, exposure and use: two benches with the same
seed but other laws draw the same photons, noise and dithers (common random numbers).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from validation.foreign.collection import Edges, Image, Light, Term, collect, poisson
from validation.foreign.device import (
    REFERENCE,
    Device,
    absorption_length,
    edge_shifts,
    scattered,
)
from validation.foreign.law import HOOKS, Law, Setting
from validation.foreign.layout import Layout
from validation.foreign.plan import LAMP, SPOT_FLUX, Exposure, Plan

NOMINAL_GAIN = 2.2
NOMINAL_NOISE = 5.5
MONITOR_ERROR = 2e-4
LAMP_WALK = 2e-4
PIXEL_RESPONSE = 3e-3
ROW_NOISE = 0.05
DARK_CURRENT = 0.01
"""Gain [e-/ADU], noise [e-], the rest relative, [e-] and [e-/s]: as in the practice campaigns."""


@dataclass
class Taken:
    """One exposure as it is recorded: frames in readout order, codes of 16 bits."""

    exposure: Exposure
    frames: list[NDArray[np.uint16]]
    monitor: float
    seconds: float


@dataclass
class Bench:
    """A sensor on its bench.

    Parameters
    ----------
    layout, plan
        What is read and recorded.
    nominal : Device
        As on the card.
    seed : int
        Fixes everything random.
    laws : sequence of Law
        Left-out physics and nuisances, in the order in which they act at one stage.
    with_noise : bool
        False: no Poisson and read noise, codes not rounded (for tests).

    Examples
    --------
    >>> from validation.foreign.device import DEVICES
    >>> plan = Plan("T", (1.0, 20.0, 40.0))
    >>> bench = Bench(Layout(pixels=128), plan, DEVICES["thick_10um"], seed=77)
    >>> flat = next(e for e in plan.exposures() if e.kind == "FLAT" and e.seconds == 20)
    >>> taken = bench.take(flat)
    >>> len(taken.frames), taken.frames[0].shape, taken.frames[0].dtype
    (2, (144, 96), dtype('uint16'))
    """

    layout: Layout
    plan: Plan
    nominal: Device
    seed: int
    laws: Sequence[Law] = ()
    with_noise: bool = True
    _edges: dict = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        rng = self.stream(None, 5)
        lay, n = self.layout, self.layout.pixels
        count = lay.amplifiers
        self.device = scattered(self.nominal, rng)
        # within 2.5 sigma, so that the brightest flats stay below 65535 codes
        self.gains = [
            NOMINAL_GAIN * (1 + 0.03 * float(np.clip(z, -2.5, 2.5)))
            for z in rng.standard_normal(count)
        ]
        self.noises = [NOMINAL_NOISE * (1 + 0.04 * z) for z in rng.standard_normal(count)]
        self.offsets = [float(o) for o in rng.uniform(900, 1600, count)]
        self.response = (1 + PIXEL_RESPONSE * rng.standard_normal((n, n))).astype(
            np.float32
        )
        y, x = np.mgrid[0:n, 0:n] / n - 0.5
        slope = 0.01 * rng.standard_normal(2)
        self.flat_shape = (1 + slope[0] * x + slope[1] * y).astype(np.float32)
        self.flat_level = LAMP * (
            1 + 0.01 * float(np.clip(rng.standard_normal(), -2.5, 2.5))
        )
        exposures = self.plan.exposures()
        self.walk = np.cumsum(LAMP_WALK * rng.standard_normal(len(exposures)))
        width = rng.uniform(1.15, 1.45)
        self.spot_sigma = width * (1 + 0.02 * rng.standard_normal(2))
        if lay.spots:
            places = np.arange(lay.spots * 0.6, n - 6, lay.spots)
            gx, gy = np.meshgrid(places, places)
            self.spot_x, self.spot_y = gx.ravel(), gy.ravel()
            self.spot_flux = SPOT_FLUX * (1 + 0.02 * rng.standard_normal(self.spot_x.size))
        self.setting = Setting(
            lay, self.plan, self.nominal, self.device, self.gains, self.noises, self.seed
        )
        for law in self.laws:
            law.begin(self.setting)
        self._at = {
            hook: [w for w in self.laws if getattr(type(w), hook) is not getattr(Law, hook)]
            for hook in HOOKS
        }

    def stream(self, exposure: Exposure | None, use: int) -> np.random.Generator:
        """Random numbers for one use of one exposure."""
        at = 10**7 if exposure is None else exposure.sequence
        return np.random.default_rng([self.seed, at, use])

    # ---------------------------------------------------------------- light
    def _light(self, e: Exposure) -> Light:
        rng = self.stream(e, 1)
        level = e.lamp * (1 + self.walk[e.sequence])
        for law in self._at["lamp"]:
            level = law.lamp(level, e)
        seconds: float | Image = e.seconds
        for law in self._at["seconds"]:
            seconds = law.seconds(seconds, e)
        if e.kind == "FLAT":
            rate = (self.flat_level * level) * self.flat_shape
            light = Light.smooth(rate.astype(np.float32), seconds)
        else:
            light = self._spots(e, level, rng)
            light.seconds = seconds
        for law in self._at["light"]:
            light = law.light(light, e)
        return light.scaled(self.response)

    def dither(self, e: Exposure) -> NDArray[np.float64]:
        """Shift of the spots' grid [pixel], in eighths of a pixel."""
        return np.round(self.stream(e, 4).uniform(-2, 2, 2) * 8) / 8

    def spot_places(self, e: Exposure) -> tuple[NDArray, NDArray]:
        """Centres of the spots [pixel], the first pixel's middle being 0."""
        dx, dy = self.dither(e)
        return self.spot_x + dx, self.spot_y + dy

    def _spots(self, e: Exposure, level: float, rng: np.random.Generator) -> Light:
        x, y = self.spot_places(e)
        sx = np.full(x.shape, self.spot_sigma[0])
        sy = np.full(x.shape, self.spot_sigma[1])
        for law in self._at["spot_shape"]:
            sx, sy = law.spot_shape(sx, sy, e)
        flux = self.spot_flux * level
        n = self.layout.pixels
        ix, px, gx = _profile(x, sx, n)
        iy, py, gy = _profile(y, sy, n)
        fy = (flux[:, None] * iy).T.astype(np.float32)
        return Light(
            rate=fy @ ix,
            across_x=fy @ px,
            across_y=(flux[:, None] * py).T.astype(np.float32) @ ix,
            slope_x=fy @ gx,
            slope_y=(flux[:, None] * gy).T.astype(np.float32) @ ix,
        )

    # ---------------------------------------------------------------- edges
    def edges(self, e: Exposure) -> Edges:
        """Law of the edges at an exposure's condition; kept while nothing in it changes."""
        device, length = self.device, absorption_length(e.wavelength)
        device = Device(
            **{**device.__dict__, "vbb": e.back_bias + self.device.vbb - REFERENCE[1]}
        )
        for law in self._at["device"]:
            device = law.device(device, e)
        for law in self._at["absorption"]:
            length = law.absorption(length, e)
        changing = self._at["terms"] or self._at["modulation"]
        key = (device, length, e.wavelength, e.back_bias, e.temperature if changing else 0)
        if key not in self._edges:
            kx, ky = edge_shifts(device, e.wavelength, absorption=length)
            terms = [Term(kx, ky)]
            for law in self._at["terms"]:
                terms = law.terms(terms, e)
            modulations = [law.modulation(e) for law in self._at["modulation"]]
            modulations = [m for m in modulations if m is not None]
            modulation = modulations[0] if modulations else None
            self._edges[key] = Edges(self.setting.shape, terms, modulation=modulation)
        edges = self._edges[key]
        edges.fixed_x = edges.fixed_y = None
        if self._at["fixed_edges"]:
            dx, dy = np.zeros((2, *self.setting.shape), np.float32)
            for law in self._at["fixed_edges"]:
                dx, dy = law.fixed_edges(dx, dy, e)
            edges.fixed_x, edges.fixed_y = dx, dy
        return edges

    # ---------------------------------------------------------------- exposure
    def charge(self, e: Exposure, *, steps: int | None = None) -> Image:
        """Charge at the end of an exposure [e-], on the sensor."""
        rng = self.stream(e, 2)
        charge = np.zeros(self.setting.shape, np.float32)
        if e.lit:
            efficiency = self._efficiency if self._at["efficiency"] else None
            charge = collect(
                self._light(e), self.edges(e), rng, efficiency=efficiency, steps=steps,
                noise=self.with_noise,
            )  # fmt: skip
        if e.seconds:
            dark = np.full(charge.shape, DARK_CURRENT * e.seconds, np.float32)
            charge += poisson(dark, self.stream(e, 6)) if self.with_noise else dark
        for hook in ("extra_charge", "stored", "remember"):
            for law in self._at[hook]:
                charge = getattr(law, hook)(charge, e)
        return charge

    def _efficiency(self, charge: Image) -> Image:
        out: Image | float = 1.0
        for law in self._at["efficiency"]:
            out = out * law.efficiency(charge)
        return out

    def read(self, charge: Image, e: Exposure) -> list[NDArray]:
        """Transfer and amplify: frames with overscans [e-], before noise."""
        lay = self.layout
        frames = []
        for k, light in enumerate(lay.cut(charge)):
            tall = np.zeros((lay.frame_shape[0], lay.width), np.float32)
            tall[: lay.height] = light
            for law in self._at["parallel"]:
                tall = law.parallel(tall, k, e)
            frame = np.zeros(lay.frame_shape, np.float32)
            frame[:, lay.prescan : lay.prescan + lay.width] = tall
            for law in self._at["serial"]:
                frame = law.serial(frame, k, e)
            frames.append(frame)
        for law in self._at["amplifiers"]:
            frames = law.amplifiers(frames, e)
        return frames

    def take(self, e: Exposure) -> Taken:
        """Take an exposure; call in the order of time where a law remembers."""
        frames = self.read(self.charge(e), e)
        rng = self.stream(e, 3)
        if self.with_noise:
            for k, frame in enumerate(frames):
                frame = frame + np.float32(self.noises[k]) * rng.standard_normal(
                    frame.shape, np.float32
                )
                frame += np.float32(ROW_NOISE) * rng.standard_normal(
                    (frame.shape[0], 1), np.float32
                )
                frames[k] = frame
        for law in self._at["noise"]:
            frames = law.noise(frames, e)
        # In single precision one code in 256 lies halfway and would be rounded to the even one.
        codes = [
            frame.astype(np.float64) / gain + offset
            for frame, gain, offset in zip(frames, self.gains, self.offsets, strict=True)
        ]
        if self.with_noise:
            codes = [np.clip(np.rint(c), 0, 65535) for c in codes]
            for law in self._at["codes"]:
                codes = law.codes(codes, e)
            codes = [np.clip(c, 0, 65535).astype(np.uint16) for c in codes]
        monitor = 0.0
        if e.lit:
            level = e.lamp * (1 + self.walk[e.sequence])
            for law in self._at["lamp"]:
                level = law.lamp(level, e)
            monitor = (
                100.0 * level * (1 + MONITOR_ERROR * self.stream(e, 7).standard_normal())
            )
        seconds = e.seconds
        for law in self._at["recorded"]:
            seconds = law.recorded(seconds, e)
        return Taken(e, codes, monitor, seconds)


def _profile(centre: NDArray, sigma: NDArray, n: int) -> tuple[NDArray, NDArray, NDArray]:
    """Gaussians along one axis: integral over each pixel, value and slope at its upper edge."""
    edge = np.arange(-1, n) + 0.5
    u = (edge - centre[:, None]) / sigma[:, None]
    whole = np.diff(ndtr(u), axis=1)
    density = np.exp(-0.5 * u[:, 1:] ** 2) / (np.sqrt(2 * np.pi) * sigma[:, None])
    slope = -u[:, 1:] / sigma[:, None] * density
    return whole.astype(np.float32), density.astype(np.float32), slope.astype(np.float32)
