"""The virtual sensor: walks light through all stages to raw frames.

Stages in true order: light, collect, store, shift, amplifier, converter.  Every random stream
is keyed by (seed, exposure, purpose), so that an effect that is switched off, or whose
amplitudes are zero, changes no bit of anything, and two campaigns that differ in an effect alone
share all their noise.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from validation.concealed.card import draw_device, shifts_at
from validation.concealed.collect import Response, collect
from validation.concealed.effect import Effect
from validation.concealed.plan import Exposure, Geometry
from validation.concealed.readout import (
    Context,
    Electronics,
    add_noise,
    to_codes,
    to_frames,
)
from validation.concealed.scene import (
    Image,
    Lamp,
    Scene,
    dithered_spots,
    flat_scene,
    spot_scene,
)

PIXEL_RESPONSE = 3.0e-3
"""Relative scatter of pixel response."""

EDGE_SCATTER = 3.0e-4
"""Scatter of pixel edges by the mask [pixel]."""

DARK_RATE = 0.01
"""[e-/s] at -100 C; doubles every 4 K."""

MONITOR_NANOAMPERE = 100.0


class Taken(NamedTuple):
    """One exposure as it leaves the camera.

    Attributes
    ----------
    exposure : Exposure
    frames : list of ndarray of uint16
        One per amplifier, readout order, shape ``geometry.raw_shape``.
    monitor : float
        Lamp monitor [nA], zero in the dark.
    """

    exposure: Exposure
    frames: list[NDArray[np.uint16]]
    monitor: float


class VirtualSensor:
    """One chip with its own scatter and what its baseline leaves out.

    Parameters
    ----------
    geometry : Geometry
    seed : int
        Fixes the chip, the lamp and all noise.
    effects : sequence of Effect, optional
        None of them: a null.

    Notes
    -----
    Exposures must be taken in the order of time by one sensor: the lamp walks, and effects
    such as persistence remember.

    Examples
    --------
    >>> from validation.concealed.plan import exposures_of, Size
    >>> size = Size(64, 1, 0, dithers=0, flat_seconds=(5.0,))
    >>> sensor = VirtualSensor(Geometry(64), seed=8231)
    >>> taken = [sensor.take(e) for e in exposures_of(size)]
    >>> taken[-5].exposure.kind, taken[-5].frames[0].shape, taken[-5].frames[0].dtype.name
    ('DARK', (80, 64), 'uint16')
    """

    def __init__(self, geometry: Geometry, *, seed: int, effects: Sequence[Effect] = ()):
        self.geometry, self.effects, self.seed = geometry, tuple(effects), int(seed)
        self.lamp = Lamp.draw(self._stream("lamp"))
        self.electronics = Electronics.draw(
            geometry.amplifiers, self._stream("electronics")
        )
        self.device = draw_device(self._stream("device"))
        for effect in self.effects:
            self.device = effect.device(self.device)
        shape = (geometry.pixels, geometry.pixels)
        response = self._stream("response").standard_normal(shape, dtype=np.float32)
        self._efficiency = 1 + np.float32(PIXEL_RESPONSE) * response
        stream, more = self._stream("edges"), geometry.pixels + 1
        self._edges = tuple(
            np.float32(EDGE_SCATTER) * stream.standard_normal(shape, dtype=np.float32)
            for shape in ((geometry.pixels, more), (more, geometry.pixels))
        )
        self._brightness = 1.0
        self._memory: dict[str, NDArray] = {}
        self._responses: dict[tuple[float, float], Response] = {}

    def truth(self) -> dict[str, Any]:
        """Return effects and nuisances, for truth.json."""
        lamp = {
            k: getattr(self.lamp, k)
            for k in ("flat_rate", "spot_rate", "spot_widths", "gradient")
        }
        return {
            "effects": [effect.truth() for effect in self.effects],
            "nuisances": {
                "device": self.device,
                "gain": self.electronics.gain,
                "noise_e": self.electronics.noise,
                "offset_adu": self.electronics.offset,
                "lamp": lamp,
            },
        }

    def take(self, exposure: Exposure) -> Taken:
        """Take one exposure."""
        context = Context(
            exposure,
            self.geometry,
            lambda word: self._stream(word, exposure.sequence),
            self.electronics,
            self.device,
            self._memory,
        )
        walk = context.stream("lamp walk").standard_normal(2)
        self._brightness *= 1 + self.lamp.walk * float(walk[0])
        charge = self._charge(context)
        for effect in self.effects:
            charge = effect.store(charge, context)
        frames = to_frames(charge, self.geometry)
        for stage in ("shift", "amplifier"):
            for effect in self.effects:
                frames = getattr(effect, stage)(frames, context)
        frames = add_noise(frames, context)
        for effect in self.effects:
            frames = effect.noise(frames, context)
        levels = self._levels(frames, context)
        for effect in self.effects:
            levels = effect.converter(levels, context)
        monitor = 0.0
        if exposure.kind in ("FLAT", "SPOT"):
            monitor = self._brightness * (1 + self.lamp.monitor_error * float(walk[1]))
        return Taken(exposure, to_codes(levels), MONITOR_NANOAMPERE * monitor)

    def _stream(self, word: str, sequence: int = -1) -> np.random.Generator:
        key = (self.seed, sequence + 1, zlib.crc32(word.encode()))
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(key)))

    def _charge(self, context: Context) -> Image:
        """Light, collection, dark current."""
        exposure = context.exposure
        charge = np.zeros((self.geometry.pixels,) * 2, np.float32)
        scene = self._scene(context)
        if scene is not None:
            for effect in self.effects:
                effect.light(scene, context)
            charge = collect(
                scene,
                self._response(context),
                context.stream("shot noise"),
                efficiency=self._efficiency,
                displaced=self._displaced(context),
            )
        warm = 2 ** ((exposure.temperature + 100.0) / 4.0)
        dark = context.stream("dark").poisson(
            DARK_RATE * warm * exposure.seconds, charge.shape
        )
        return charge + dark.astype(np.float32)

    def _scene(self, context: Context) -> Scene | None:
        exposure, pixels = context.exposure, self.geometry.pixels
        if exposure.kind == "FLAT":
            return flat_scene(self.lamp, pixels, exposure.seconds, self._brightness)
        if exposure.kind != "SPOT":
            return None
        asked: dict[str, float] = {"variance": 0.0, "halo": 0.0, "halo_sigma": 1.0}
        for effect in self.effects:
            asked.update(effect.spot_light(context))
        width = self.lamp.spot_widths
        sigma = tuple(float(np.sqrt(w * w + asked["variance"])) for w in width)
        places, fluxes = dithered_spots(pixels, context.stream("spots"))
        fluxes = fluxes * self.lamp.spot_rate * exposure.seconds * self._brightness
        scene = spot_scene(places, fluxes * (1 - asked["halo"]), sigma, pixels)
        if asked["halo"]:
            wide = tuple(float(np.hypot(s, asked["halo_sigma"])) for s in sigma)
            scene.add(spot_scene(places, fluxes * asked["halo"], wide, pixels))
        return scene

    def _displaced(self, context: Context) -> tuple[Image, Image]:
        x, y = self._edges
        for effect in self.effects:
            if (more := effect.displaced(context)) is not None:
                x, y = x + more[0], y + more[1]
        return x, y

    def _response(self, context: Context) -> Response:
        """Shifts at the exposure's condition, kept for the next one."""
        condition = (context.exposure.wavelength, context.exposure.back_bias)
        if condition not in self._responses:
            shifts = shifts_at(self.device, *condition)
            laws: dict[str, Any] = {}
            for effect in self.effects:
                shifts = effect.shifts(shifts, context)
                laws.update(effect.laws(context))
            self._responses[condition] = Response.of(shifts, self.geometry.pixels, **laws)
        return self._responses[condition]

    def _levels(self, frames: list[Image], context: Context) -> list[NDArray[np.float64]]:
        """Electrons to ADU on top of the offsets."""
        factor = 1.0
        for effect in self.effects:
            factor *= effect.gain(context)
        return [
            f.astype(np.float64) * (factor / gain) + offset
            for f, gain, offset in zip(
                frames, self.electronics.gain, self.electronics.offset, strict=True
            )
        ]
