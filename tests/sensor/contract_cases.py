"""Both sensors, photons for them and images."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, SiliconSensor

BOTH = pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])
RINGS = galsim.SiliconSensor.simple_treerings(0.3, 40.0, r_max=200.0)


def make(kind, **options):
    return kind(rng=galsim.BaseDeviate(6007), **options)


def photons(count=30_000, seed=71, *, full=False, flux=1.0, width=2.0):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0, width, (2, count))
    extra = {}
    if full:
        extra = {
            "dxdz": rng.normal(0, 0.1, count), "dydz": rng.normal(0, 0.1, count),
            "wavelength": rng.uniform(400, 1000, count),
        }  # fmt: skip
    return galsim.PhotonArray(count, x, y, np.full(count, flux), **extra)


def blank(side=21, dtype=np.float32):
    image = galsim.Image(side, side, dtype=dtype)
    image.setCenter(0, 0)
    return image


def part(all_photons, lo, hi):
    some = galsim.PhotonArray(hi - lo)
    if hi == lo:
        return some
    some.copyFrom(all_photons, source_indices=slice(lo, hi))
    return some


def draw(sensor, all_photons=None, **options):
    """Pixels of one exposure."""
    image = blank(**options)
    sensor.accumulate(photons() if all_photons is None else all_photons, image)
    return image.array
