"""Light on the sensor: lamp, illumination, spots, with everything that is not an effect.

A scene is electrons expected in each pixel if no edge moved, and the same light along the
right and upper edge of each pixel with its first two derivatives across the edge: the charge
that an edge displaced by s pixels takes from its neighbour is
``s (I + s I' / 2 + s^2 I'' / 6)``, exact for s^3 (0.15 pixel on a spot of one pixel: 2e-5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from validation.concealed.card import absorption_length
from validation.concealed.plan import Exposure

Image = NDArray[np.float32]

BOLTZMANN = 8.617333e-5
"""[eV/K]."""

ZERO_CELSIUS = 273.15


@dataclass
class Scene:
    """Electrons expected in one exposure, before response and moved edges.

    Attributes
    ----------
    light : ndarray, shape (ny, nx)
        In each undisplaced pixel [e-].
    right, upper : tuple of three ndarrays, or None
        Light along the right (upper) edge of each pixel [e-/pixel] and its first and second
        derivative towards larger x (y).  None for flats: the light of the pixel itself.
    even : ndarray, or None
        Light without fringes, whose charge repels evenly; by default all light.
    """

    light: Image
    right: tuple[Image, Image, Image] | None = None
    upper: tuple[Image, Image, Image] | None = None
    even: Image | None = None

    def scale(self, factor: Image | float) -> None:
        """Multiply the light by a number or by a map that is smooth over a pixel."""
        self.light = np.asarray(self.light * factor, dtype=np.float32)
        for side in ("right", "upper"):
            if (old := getattr(self, side)) is not None:
                setattr(self, side, tuple(np.asarray(i * factor, np.float32) for i in old))

    def add(self, other: Scene) -> None:
        """Add the light of another scene of the same kind."""
        self.light = self.light + other.light
        for side in ("right", "upper"):
            if (old := getattr(self, side)) is not None:
                new = zip(old, getattr(other, side), strict=True)
                setattr(self, side, tuple(a + b for a, b in new))


@dataclass(frozen=True)
class Lamp:
    """The light source and the optics, drawn once a campaign.

    Attributes
    ----------
    flat_rate, spot_rate : float
        [e-/s] in a pixel of a flat, in a whole spot.
    gradient : tuple of float
        Relative slope in x, y and curvature in x^2, xy, y^2 across half the sensor.
    spot_widths : tuple of float
        Standard deviations of a spot in x and y [pixel], the same at all conditions: diffusion
        included, as the card does not speak of it.
    walk, monitor_error : float
        Relative step of the lamp from exposure to exposure; relative error of its monitor.
    """

    flat_rate: float = 2000.0
    spot_rate: float = 32300.0
    gradient: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    spot_widths: tuple[float, float] = (1.06, 1.06)
    walk: float = 2.0e-4
    monitor_error: float = 2.0e-4

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Lamp:
        """Draw a lamp: rates to 2 %, spot widths to 2 % each, gradients of about 0.3 %."""
        rates = 1 + 0.02 * np.clip(rng.standard_normal(4), -2.5, 2.5)
        gradient = rng.normal(0, [3e-3, 3e-3, 5e-4, 5e-4, 5e-4])
        return cls(
            flat_rate=2000.0 * float(rates[0]),
            spot_rate=32300.0 * float(rates[1]),
            spot_widths=(1.06 * float(rates[2]), 1.06 * float(rates[3])),
            gradient=tuple(float(g) for g in gradient),
        )


def coordinates(pixels: int) -> tuple[Image, Image]:
    """Return x and y of pixel centres, -1 to 1 from edge to edge of the sensor."""
    along = ((np.arange(pixels) + 0.5) / pixels * 2 - 1).astype(np.float32)
    return along[None, :], along[:, None]


def flat_scene(lamp: Lamp, pixels: int, seconds: float, brightness: float) -> Scene:
    """Return the scene of a flat; ``brightness`` is the lamp's present over its nominal one."""
    x, y = coordinates(pixels)
    gx, gy, gxx, gxy, gyy = (np.float32(g) for g in lamp.gradient)
    shape = 1 + gx * x + gy * y + gxx * x * x + gxy * x * y + gyy * y * y
    return Scene(
        (np.float32(lamp.flat_rate * seconds * brightness) * shape).astype(np.float32)
    )


def diffusion_variance(exposure: Exposure, device: dict[str, float]) -> float:
    """Variance of thermal spreading [pixel^2]: 2 kT/q times the drift path over the field.

    Averaged over conversion depth, in the mean field of the slab (the field's slope changes it
    by less than 3 %).
    """
    thickness = device["thickness"]
    volts = device["vfront"] - exposure.back_bias
    absorption = absorption_length(exposure.wavelength)
    cut = np.exp(-thickness / absorption)
    depth = absorption - thickness * cut / (1 - cut)
    heat = BOLTZMANN * (exposure.temperature + ZERO_CELSIUS)
    return float(2 * heat * thickness * (thickness - depth) / volts / device["pixel"] ** 2)


def spot_grid(pixels: int, pitch: int = 30, margin: int = 18) -> NDArray[np.float64]:
    """Return the nominal places (x, y) of the spots [pixel], shape (n, 2)."""
    places = np.arange(margin, pixels - 13, pitch, dtype=float)
    return np.array([(x, y) for y in places for x in places])


def dithered_spots(pixels: int, rng: np.random.Generator):
    """Places and relative fluxes of one exposure's spots.

    Each spot falls at its own place on a grid of 1/8 pixel, offset by 1/16; pinholes differ
    in brightness by 2 %.
    """
    places = spot_grid(pixels)
    phase = (rng.integers(0, 8, size=places.shape) - 3.5) / 8
    return places + phase, 1 + 0.02 * rng.standard_normal(len(places))


def spot_scene(places, fluxes, widths: tuple[float, float], pixels: int) -> Scene:
    """Gaussian spots, integrated over pixels, with light at the edges.

    ``places`` (n, 2) are x and y in pixels, the centre of the first pixel at zero; ``fluxes``
    (n,) in electrons; ``widths`` standard deviations in x and y [pixel].
    """
    light = np.zeros((pixels, pixels), np.float32)
    right = tuple(np.zeros_like(light) for _ in range(3))
    upper = tuple(np.zeros_like(light) for _ in range(3))
    reach = int(np.ceil(7 * max(widths))) + 1
    for (x, y), flux in zip(places, fluxes, strict=True):
        window_x, mean_x, edge_x = _profile(x, widths[0], reach, pixels)
        window_y, mean_y, edge_y = _profile(y, widths[1], reach, pixels)
        stamp = np.s_[window_y, window_x]
        light[stamp] += np.outer(flux * mean_y, mean_x)
        for k in range(3):
            right[k][stamp] += np.outer(flux * mean_y, edge_x[k])
            upper[k][stamp] += np.outer(flux * edge_y[k], mean_x)
    return Scene(light, right, upper)


def _profile(centre, sigma, reach, pixels):
    """Window, pixel integrals and edge values with two derivatives of one Gaussian."""
    low = max(round(centre) - reach, 0)
    high = min(round(centre) + reach + 1, pixels)
    edges = np.arange(low, high + 1) - 0.5 - centre
    integral = 0.5 * np.diff(erf(edges / (sigma * np.sqrt(2))))
    u = edges[1:] / sigma
    density = np.exp(-0.5 * u * u) / (sigma * np.sqrt(2 * np.pi))
    return (
        slice(low, high),
        integral,
        (density, -u / sigma * density, (u * u - 1) / sigma**2 * density),
    )
