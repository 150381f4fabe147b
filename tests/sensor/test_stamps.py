"""Exposures of one image after another of the same size, which use the same arrays again."""

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, SiliconSensor
from bfsensor.sensor.image_exposure import SMALL


def _star(seed, count, flux=1.0):
    """A star of ``count`` photons, some beside the image."""
    x, y = np.random.default_rng(seed).normal(0, 3, (2, count))
    return galsim.PhotonArray(count, x, y, np.full(count, flux))


def _stamp(dtype, level):
    """Image with ``level`` electrons a pixel, which no full pixel tells from another."""
    image = galsim.Image(24, 21, dtype=dtype)
    image.setCenter(0, 0)
    image.array[...] = level
    return image


OPTIONS = [
    {},
    {"full_well": 20_000.0},
    {"surroundings": "mirrored"},
    {"surroundings": 3000.0},
    {"charge_response": False},
]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_stamp_after_another_is_that_of_a_new_sensor(options, dtype):
    """Nothing of one exposure is left in the next, bit for bit: charge, spilling, hot edges, counts."""
    sensor = BrighterFatterSensor(rng=galsim.BaseDeviate(8124), nrecalc=2e5, **options)
    bright = _stamp(dtype, 500.5)
    sensor.accumulate(_star(31, 30_000, 40.25), bright)
    first = sensor._exposure
    assert first.hot.used[1] > 0
    assert first.ledger.counters.any()
    if "full_well" in options:
        assert sensor.diagnostics["spilled"] > 0
    faint = [_stamp(dtype, 0.0) for _ in range(2)]
    fresh = BrighterFatterSensor(rng=galsim.BaseDeviate(8124), nrecalc=2e5, **options)
    fresh.rng.discard(2)
    for which, image in zip((sensor, fresh), faint, strict=True):
        for n in range(3):
            which.accumulate(_star(57 + n, 9000, 25.25), image, resume=n > 0)
    assert sensor._exposure is first
    assert np.array_equal(faint[0].array, faint[1].array)
    assert sensor.diagnostics == fresh.diagnostics
    for one, other in (
        (sensor._exposure.charges, fresh._exposure.charges),
        (sensor._exposure.ledger, fresh._exposure.ledger),
    ):
        for name in ("first", "near", "margins", "ranges", "carry", "strikes", "sums"):
            if hasattr(one, name):
                assert np.array_equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.parametrize("kind", [BrighterFatterSensor, SiliconSensor])
def test_only_small_images_of_the_same_kind_share_arrays(kind):
    """Another shape or precision, or a large image, has arrays of its own."""
    sensor = kind(rng=galsim.BaseDeviate(5))
    light = _star(7, 100)
    exposures = []
    for shape, dtype in (((8, 8), float), ((8, 9), float), ((8, 9), np.float32)):
        sensor.accumulate(light, galsim.Image(*shape, dtype=dtype))
        exposures.append(sensor._exposure)
    sensor.accumulate(light, galsim.Image(8, 9, dtype=np.float32))
    assert sensor._exposure is exposures[-1]
    assert len({id(e) for e in exposures}) == 3
    for _ in range(2):
        sensor.accumulate(light, galsim.Image(SMALL // 64 + 1, 64, dtype=float))
        exposures.append(sensor._exposure)
    assert exposures[-1] is not exposures[-2]
