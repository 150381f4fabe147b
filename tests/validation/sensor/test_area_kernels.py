"""Areas by convolution, against the polygons of each pixel drawn in full."""

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, DistortionTable, SiliconSensor
from bfsensor._kernels.areas import charge_ranges, pixel_areas
from bfsensor._kernels.shifts import MODES
from bfsensor.device.shipped import tables_dir
from bfsensor.sensor.flats import draw_flat
from bfsensor.sensor.image_exposure import ImageExposure
from tests.kernels.plain_edges import NO_PATTERN
from validation.sensor.sensor_flats import predict

BOTH = pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])


def polygons(sensor, image):
    """Areas by the kernel that walks around each pixel, which is tested against numpy."""
    charges = ImageExposure(image, sensor._physics, NO_PATTERN, (0.0, 0.0), (0, 0)).charges
    out = np.empty(image.shape)
    lows, highs = np.empty((2, MODES), np.float32)
    charge_ranges(charges, lows, highs)
    pixel_areas(
        sensor._physics.edges, charges, NO_PATTERN, True, lows, 0, image.shape[0], out
    )
    return out


def pictures(shape):
    rng = np.random.default_rng(40111)
    spot = np.zeros(shape)
    spot[shape[0] // 2, shape[1] // 3] = 1.5e5
    corner = np.zeros(shape)
    corner[:2, -2:] = 1e5
    return {
        "flat with noise": rng.poisson(5e4, shape).astype(float),
        "random": rng.uniform(0, 1.2e5, shape),
        "one pixel": spot,
        "corner": corner,
        "empty": np.zeros(shape),
    }


@BOTH
@pytest.mark.parametrize("name", pictures((2, 3)))
def test_convolved_areas_are_those_of_the_polygons(kind, name):
    sensor = kind(rng=galsim.BaseDeviate(1))
    image = pictures((33, 45))[name]
    areas = sensor.calculate_pixel_areas(galsim.ImageD(image)).array
    expected = polygons(sensor, image)
    # The quadratic form drops kernels worth 2e-8 each; shifts are in single precision.
    assert np.abs(areas - expected).max() < 1e-6
    assert (np.abs(areas - 1).max() > 0.01) == (name != "empty")


@BOTH
def test_large_images_are_summed_in_single_precision(kind):
    """From 512 x 512 on, as good to 1e-6 all the same."""
    sensor = kind(rng=galsim.BaseDeviate(1))
    image = pictures((512, 520))["random"]
    areas = sensor.calculate_pixel_areas(galsim.ImageD(image)).array
    assert np.abs(areas - polygons(sensor, image)).max() < 2e-6


@BOTH
def test_tiny_images_have_areas(kind):
    sensor = kind(rng=galsim.BaseDeviate(1))
    for shape in ((1, 1), (1, 7), (3, 2)):
        image = np.full(shape, 8e4)
        areas = sensor.calculate_pixel_areas(galsim.ImageD(image)).array
        assert np.abs(areas - polygons(sensor, image)).max() < 1e-6


def test_flats_in_few_steps_lack_one_part_in_the_square_of_their_number():
    """Fluctuations of a step act in the next; left out, four steps would lack a quarter."""
    sensor = BrighterFatterSensor("e2v_ccd250", rng=galsim.BaseDeviate(3))
    level, count = 5e4, 8
    deficits = []
    for n in range(count):
        flat = draw_flat(
            sensor, (256, 256), level, step=level / 4, rng=galsim.BaseDeviate(8100 + n),
            dtype=np.float64,
        ).array  # fmt: skip
        deficits.append((flat.var() - level) / level**2)
    table = DistortionTable.read(tables_dir() / "e2v_ccd250" / "table.fits")
    implied = (predict(table, level)[0, 0] - level) / level**2
    error = np.sqrt(2 / 256**2 / count) / level
    assert error < 0.02 * abs(implied)
    assert abs(np.mean(deficits) - (1 - 1 / 16) * implied) < 4 * error
