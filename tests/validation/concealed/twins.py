"""Pairs of exposures that differ in one effect alone, and the little statistics they need."""

import numpy as np

from validation.concealed.plan import Exposure, Geometry
from validation.concealed.sensor import VirtualSensor

SEED = 90210


def electrons(sensor, taken):
    """Frames in electrons above the offset."""
    e = sensor.electronics
    return [
        (f.astype(float) - o) * g
        for f, g, o in zip(taken.frames, e.gain, e.offset, strict=True)
    ]


def exposure(kind, seconds, sequence=0, **condition):
    return Exposure(kind, sequence, 60000.0 + sequence / 24.0, seconds, **condition)


def take_twins(effect, exposures, *, pixels=128, seed=SEED):
    """Frames in electrons without and with the effect, one pair of lists per exposure."""
    sensors = [
        VirtualSensor(Geometry(pixels), seed=seed, effects=e) for e in ((), (effect,))
    ]
    return [tuple(electrons(s, s.take(e)) for s in sensors) for e in exposures]


def image(frames, geometry=None, pixels=128):
    """Put amplifier frames together as the light fell."""
    g = geometry or Geometry(pixels)
    light = [f[: g.pixels, g.prescan : g.prescan + g.width] for f in frames]
    return np.hstack([part[:, ::-1] if k % 2 else part for k, part in enumerate(light)])


def image_twins(effect, exposures, **kwargs):
    pixels = kwargs.get("pixels", 128)
    return [
        tuple(image(f, pixels=pixels) for f in pair)
        for pair in take_twins(effect, exposures, **kwargs)
    ]


def flat_power(shifts_area, mu, pixels, *, law=lambda s: 0.0 * s, nodes=40):
    """Power of a flat, dP/dmu = 1 + 2 a (1 + law(mu)) P, by Gauss-Legendre over the charge.

    ``law`` is the antiderivative of the curvature; zero gives (exp(2 a mu) - 1) / (2 a).
    """
    half = shifts_area.shape[0] // 2
    grid = np.zeros((pixels, pixels))
    side = np.arange(-half, half + 1) % pixels
    np.add.at(grid, (side[:, None], side[None, :]), shifts_area)
    a = np.fft.fft2(grid).real
    x, w = np.polynomial.legendre.leggauss(nodes)
    s, w = (x + 1) / 2 * mu, w / 2 * mu
    return sum(
        wi * np.exp(2 * a * (mu - si + law(mu) - law(si)))
        for si, wi in zip(s, w, strict=True)
    )


def covariances(power, lags=3):
    return np.fft.ifft2(power).real[:lags, :lags]
