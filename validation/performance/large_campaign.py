"""A campaign of a large sensor of 16 amplifiers whose frames are made as they are read.

Frames have what costs time and memory: Poisson and read noise, pixels that respond unlike, a
gradient of the light, overscans on all sides, thousands of spots.  They have no brighter-fatter
effect; charge may be left behind in the serial register.  Exposures are the same bit for bit whenever
they are made.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy.special import ndtr

from bfsensor.recording.campaign.amplifiers import AmplifierFrame
from bfsensor.recording.campaign.exposures import Exposure
from bfsensor.recording.raw.sections import AmplifierLayout

SIDES = 512, 2002
"""Columns and rows of an amplifier of a sensor of 4096 x 4004 pixels."""

PRESCAN, OVERSCAN, ROWS = 10, 54, 46
"""Columns before and after an amplifier's image, and rows after it."""

COLUMNS = 8
"""Amplifiers side by side, in two rows that read towards the lower and the upper edge."""

GAIN, READ_NOISE, BIAS = 1.5, 6.0, 1000.0
"""[e-/ADU], [e-], [ADU]."""

SECONDS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0)
RATE, SPOT_RATE, DARK = 1500.0, 11_000.0, 0.02
"""Electrons a second in a pixel of a flat, in a spot, and in the dark: nothing saturates."""

CONDITIONS = ((620.0, -60.0), (870.0, -60.0), (620.0, -50.0))
"""Wavelength [nm] and back bias [V]; the first is that of most exposures."""

PITCH, STAMP, WIDTH = 40, 21, 1.06
"""Of the spots [pixel]."""

GAUSSIAN = 1000.0
"""Mean [e-] from which on a Gaussian stands for Poisson's law."""


class LargeCampaign:
    """Exposures and their frames, as :class:`bfsensor.diagnose.data.measure_channels.Source` has them.

    Parameters
    ----------
    exposures : int
        About how many, 24 or more: of 300, 20 biases, 10 darks, 160 flats at the first condition
        and 32 at either of two others, 46 of spots.
    seed : int
        Of all noise.
    cti : float
        Part of a pixel's charge that each serial transfer leaves to the next pixel.
    sides : (int, int)
        Columns and rows of the image of an amplifier.
    pairs : int, optional
        Pairs of flats at each level of the first condition; by default their share of 300.
    """

    lamp_error = 2e-4

    def __init__(
        self,
        exposures: int = 300,
        *,
        seed: int = 8414,
        cti: float = 0.0,
        sides: tuple[int, int] = SIDES,
        pairs: int | None = None,
    ) -> None:
        self._seed, self._cti, self._sides = seed, cti, sides
        self.shape = (2 * sides[1], COLUMNS * sides[0])
        rng = np.random.default_rng(seed)
        y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in self.shape)
        self._response = 1 + np.float32(0.005) * rng.standard_normal(self.shape, np.float32)
        self._response *= 1 + 0.01 * x[None] - 0.005 * y[:, None] + 0.004 * (x**2)[None]
        self.layouts = [_layout(n, *sides) for n in range(2 * COLUMNS)]
        self.exposures = _plan(exposures, pairs)

    def write_baseline(self, path: Path) -> None:
        """Write edge displacements as they are here: none."""
        nothing = np.zeros((11, 11)).tolist()
        edges = {f"{w:g}_{b:g}": {"kx": nothing, "ky": nothing} for w, b in CONDITIONS}
        path.write_text(json.dumps({"conditions": edges}))

    def read(self, exposure: Exposure) -> Sequence[AmplifierFrame]:
        """Make the frames of an exposure."""
        rng = np.random.default_rng([self._seed, exposure.number])
        light = self._light(exposure, rng)
        return tuple(self._frame(one, light, exposure, rng) for one in self.layouts)

    def _light(
        self, exposure: Exposure, rng: np.random.Generator
    ) -> NDArray[np.float32] | float:
        """Mean electrons of each pixel of the sensor."""
        seconds, lamp = exposure.exposure_time or 0.0, exposure.lamp or 0.0
        dark = DARK * seconds
        if exposure.kind == "flat":
            return np.float32(RATE * seconds * lamp) * self._response + np.float32(dark)
        if exposure.kind != "spot":
            return dark
        ny, nx = self.shape
        places = np.array([
            (x, y) for y in range(STAMP, ny - STAMP, PITCH) for x in range(STAMP, nx - STAMP, PITCH)
        ])  # fmt: skip
        phase = rng.uniform(-0.5, 0.5, places.shape)
        edge = np.arange(STAMP + 1) - STAMP / 2
        along = np.diff(ndtr((edge - phase[..., None]) / WIDTH), axis=2)
        flux = SPOT_RATE * seconds * lamp * (1 + 0.02 * rng.standard_normal(len(places)))
        at = np.arange(STAMP) - STAMP // 2
        image = np.full(self.shape, dark, np.float32)
        stamps = flux[:, None, None] * along[:, 1, :, None] * along[:, 0, None]
        image[places[:, 1, None, None] + at[:, None], places[:, 0, None, None] + at] += (
            stamps
        )
        return image

    def _frame(
        self,
        layout: AmplifierLayout,
        light: NDArray[np.float32] | float,
        exposure: Exposure,
        rng: np.random.Generator,
    ) -> AmplifierFrame:
        """One amplifier in readout order, whole numbers as a converter gives them."""
        noise = np.float32(READ_NOISE / GAIN)
        pixels = noise * rng.standard_normal(layout.stored, np.float32) + np.float32(BIAS)
        x, y = layout.origin or (0, 0)
        columns, rows = self._sides
        if isinstance(light, float):
            mean: NDArray[np.float32] | float = light
        else:
            mean = light[y : y + rows, x : x + columns]
            mean = mean[:: -1 if layout.flip_y else 1, :: -1 if layout.flip_x else 1]
        if exposure.kind == "flat" and RATE * (exposure.exposure_time or 0.0) >= GAUSSIAN:
            drawn = mean + np.sqrt(mean) * rng.standard_normal((rows, columns), np.float32)
        else:
            drawn = rng.poisson(mean, (rows, columns))
        charge = np.zeros(layout.stored, np.float32)
        charge[layout.data] = drawn
        if self._cti:
            # A column is shifted once for each column before it, and once into the amplifier.
            lost = np.arange(1, charge.shape[1] + 1, dtype=np.float32) * np.float32(
                self._cti
            )
            left = charge * lost
            charge -= left
            charge[:, 1:] += left[:, :-1]
        charge /= np.float32(GAIN)
        pixels += charge
        # Not rint, which gives what single precision leaves halfway to even codes.
        np.clip(np.floor(pixels + np.float32(0.5), out=pixels), 0, 65535, out=pixels)
        bad = pixels >= 65535
        return AmplifierFrame(layout.name, pixels, bad, layout, 65535.0, exposure.number)

    def write(self, folder: Path, *, compress: bool = True) -> None:
        """Write every exposure as a file with an extension for each amplifier.

        Parameters
        ----------
        folder : Path
            A new folder.
        compress : bool
            Whether images are tile-compressed, or stored as plain 16 bit integers.
        """
        folder.mkdir(parents=True)
        for one in self.exposures:
            cards = {
                "IMGTYPE": one.kind.upper(), "EXPTIME": one.exposure_time, "SEQNUM": one.number,
                "MJD-OBS": one.mjd, "MONOWL": one.wavelength, "VBB": one.back_bias,
                "CCDTEMP": -100.0,
            }  # fmt: skip
            if one.lamp is not None:
                cards["MONDIODE"] = one.lamp
            hdus: list[fits.hdu.base.ExtensionHDU] = [
                fits.PrimaryHDU(header=fits.Header(cards))
            ]
            for frame in self.read(one):
                pixels = frame.pixels.astype(np.uint16)
                header = fits.Header(_sections(frame.layout))
                image = fits.CompImageHDU if compress else fits.ImageHDU
                hdus.append(image(pixels, header, name=frame.name))
            name = f"{one.kind}_{one.number:04d}.fits" + (".fz" if compress else "")
            fits.HDUList(hdus).writeto(folder / name)


def _layout(number: int, nx: int, ny: int) -> AmplifierLayout:
    """Amplifiers 0 to 7 read downwards, 8 to 15 upwards; every other one to the right."""
    column, top = number % COLUMNS, number // COLUMNS
    shape = ny + ROWS, PRESCAN + nx + OVERSCAN
    return AmplifierLayout(
        f"SEGMENT{top}{column}", number + 1, shape, np.s_[: shape[0], : shape[1]], False, False,
        np.s_[0:ny, PRESCAN : PRESCAN + nx],
        np.s_[0 : shape[0], PRESCAN + nx : shape[1]],
        (column * nx, top * ny), bool(column % 2), bool(top), (ny, nx), saturation=65535.0,
    )  # fmt: skip


def _sections(layout: AmplifierLayout) -> dict[str, str]:
    (x, y), (ny, nx) = layout.origin or (0, 0), layout.shape
    across, up = (x + 1, x + nx), (y + 1, y + ny)
    across = across[:: -1 if layout.flip_x else 1]
    up = up[:: -1 if layout.flip_y else 1]
    return {
        "DATASEC": f"[{PRESCAN + 1}:{PRESCAN + nx},1:{ny}]",
        "BIASSEC": f"[{PRESCAN + nx + 1}:{layout.stored[1]},1:{layout.stored[0]}]",
        "DETSEC": f"[{across[0]}:{across[1]},{up[0]}:{up[1]}]",
    }


def _plan(count: int, pairs: int | None) -> list[Exposure]:
    """Biases, darks, pairs of flats at eight levels and spots, in the shares of 300."""
    share = max(count / 300, 0.0)
    rng = np.random.default_rng(5)
    wanted: list[tuple[str, float, tuple[float, float]]] = []
    wanted += [("bias", 0.0, CONDITIONS[0])] * max(round(20 * share), 2)
    wanted += [
        ("dark", (60.0, 300.0)[n % 2], CONDITIONS[0])
        for n in range(max(round(10 * share), 2))
    ]
    usual = round(10 * share), round(2 * share), round(2 * share)
    first = usual[0] if pairs is None else pairs
    for condition, number in zip(CONDITIONS, (first, *usual[1:]), strict=True):
        for _ in range(number):
            wanted += [("flat", s, condition) for s in SECONDS for _ in (0, 1)]
    more = (first - usual[0]) * 2 * len(SECONDS)
    left = max(count - (len(wanted) - more), 3)
    for n in range(left):
        # Two thirds at the first condition, the others in turn.
        turn = 0 if n % 3 < 2 else 1 + n // 3 % 2
        wanted.append(("spot", SECONDS[-1 - n % len(SECONDS)], CONDITIONS[turn]))
    out = []
    for n, (kind, seconds, (wavelength, bias)) in enumerate(wanted):
        lit = kind in ("flat", "spot")
        out.append(Exposure(
            n, Path(f"{kind}_{n:04d}"), kind, n, seconds, 60000.0 + n / 1000,
            wavelength if lit else None, None, bias, temperature=173.15,
            lamp=float(1 + 2e-4 * rng.standard_normal()) if lit else None,
        ))  # fmt: skip
    return out
