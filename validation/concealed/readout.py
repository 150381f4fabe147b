"""Readout: charge becomes amplifier frames in readout order, then converter codes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from validation.concealed.plan import Exposure, Geometry
from validation.concealed.scene import Image

LARGEST_CODE = 65535
NOMINAL_GAIN = 2.2
NOMINAL_NOISE = 5.5


@dataclass(frozen=True)
class Electronics:
    """One chip's amplifiers: gains [e-/ADU], noise [e-], offsets [ADU], row noise [e-]."""

    gain: tuple[float, ...]
    noise: tuple[float, ...]
    offset: tuple[float, ...]
    row_noise: float = 0.05

    @classmethod
    def draw(cls, amplifiers: int, rng: np.random.Generator) -> Electronics:
        """Draw electronics: gains and noises to 3 and 4 %, cut so that 1.2e5 e- fit the codes."""
        scatter = np.clip(rng.standard_normal((3, amplifiers)), -2.5, 2.5)
        return cls(
            gain=tuple(float(g) for g in NOMINAL_GAIN * (1 + 0.03 * scatter[0])),
            noise=tuple(float(n) for n in NOMINAL_NOISE * (1 + 0.04 * scatter[1])),
            offset=tuple(float(o) for o in 1000 + 20 * scatter[2]),
        )


@dataclass
class Context:
    """What an effect may know of the exposure it acts on.

    Attributes
    ----------
    exposure, geometry : Exposure, Geometry
    stream : callable
        ``stream(word)`` gives the random stream of that word for this exposure; an effect's
        draws never move another's.
    electronics : Electronics
    device : dict
        The true device.
    memory : dict
        Kept from exposure to exposure by those effects that remember.
    """

    exposure: Exposure
    geometry: Geometry
    stream: Callable[[str], np.random.Generator]
    electronics: Electronics
    device: dict[str, float]
    memory: dict[str, NDArray] = field(default_factory=dict)


def to_frames(charge: Image, geometry: Geometry) -> list[Image]:
    """Cut the image into amplifier frames [e-], first-read pixel first, overscans empty."""
    frames = []
    for amplifier in range(geometry.amplifiers):
        low = amplifier * geometry.width
        strip = charge[:, low : low + geometry.width]
        frame = np.zeros(geometry.raw_shape, np.float32)
        light = frame[
            : geometry.pixels, geometry.prescan : geometry.prescan + geometry.width
        ]
        light[...] = strip[:, ::-1] if amplifier % 2 else strip
        frames.append(frame)
    return frames


def add_noise(frames: list[Image], context: Context) -> list[Image]:
    """Add white read noise and a little row noise [e-]."""
    stream = context.stream("read noise")
    rows = context.electronics.row_noise
    out = []
    for frame, noise in zip(frames, context.electronics.noise, strict=True):
        white = stream.standard_normal(frame.shape, dtype=np.float32) * np.float32(noise)
        stripes = stream.standard_normal((frame.shape[0], 1)) * rows
        out.append(frame + white + stripes.astype(np.float32))
    return out


def to_codes(levels: list[NDArray[np.float64]]) -> list[NDArray[np.uint16]]:
    """Round levels [ADU] to codes of a perfect converter."""
    return [np.clip(np.rint(x), 0, LARGEST_CODE).astype(np.uint16) for x in levels]
