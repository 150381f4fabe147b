"""Effects on light in the sensor, and that all effects give the same bits however they are cut."""

from __future__ import annotations

import galsim
import numpy as np
import pytest
from scipy.special import erf

from bfsensor import BrighterFatterSensor
from bfsensor.effects.library import make_effect
from bfsensor.sensor.flats import draw_flat
from tests.sensor.contract_cases import blank, draw, part, photons
from tests.sensor.effect_cases import (
    LAYOUT,
    Bent,
    Coloured,
    Rough,
    Shade,
    Tail,
    Wide,
    areas_of,
    entry,
    flat_photons,
    sensor_with,
    single,
    write_report,
)

# -- light ---------------------------------------------------------------------------------


def test_added_variance_and_halo():
    count, var, share = 1_000_000, 0.1, 0.04
    effect = Wide({"var": var, "frac": share})
    sensor = sensor_with(effect, strength=0.0, diffusion_factor=0.0)
    side = np.arange(101) - 50.0
    image = blank(101)
    sensor.accumulate(photons(count, width=1.0), image)
    profile = image.array.astype(float).sum(0) / count
    # A pixel's own 1/12, the halo's 25 pixel^2; the fourth moment gives the error.
    expected = 1.0 + var + 1 / 12 + share * 25
    error = np.sqrt((profile @ side**4 - expected**2) / count)
    assert profile @ side**2 == pytest.approx(expected, abs=4 * error)
    far = profile[np.abs(side) > 6].sum()
    # Beyond 6.5 pixels of a Gaussian of sqrt(26.1) pixels.
    expected = share * (1 - erf(6.5 / np.sqrt(2 * 26.1)))
    assert far == pytest.approx(expected, abs=4 * np.sqrt(expected / count) + 1e-5)


def test_light_is_thinned_or_scaled():
    shape, count = (32, 32), 4_000_000
    options = {"layout": {"shape": shape}, "strength": 0.0, "diffusion_factor": 0.0}
    effect = Shade({"dt": 3.0})
    sensor = sensor_with(effect, conditions={"seconds": 10.0}, **options)
    image = galsim.ImageD(32, 32)
    sensor.accumulate(flat_photons(shape, count, 46), image)
    level = count / 1024
    left, right = image.array[:, :16], image.array[:, 16:]
    for half, factor, spread in ((left, 0.7, 0.7), (right, 1.3, 1.3**2)):
        # Fewer photons are Poisson numbers as before; more cannot be had but by scaling.
        error = np.sqrt(spread * level / 512)
        assert half.mean() == pytest.approx(factor * level, abs=4 * error)
        assert half.var() == pytest.approx(spread * level, rel=4 * np.sqrt(2 / 512))
    assert np.all(left == np.round(left))
    flat = draw_flat(sensor, shape, 5e4, rng=galsim.BaseDeviate(3)).array
    ratio = flat[:, 16:].mean() / flat[:, :16].mean()
    assert ratio == pytest.approx(1.3 / 0.7, rel=4 * np.sqrt(2 / 5e4 / 512))


# -- reproducible --------------------------------------------------------------------------


def test_same_bits_for_any_chunks_and_threads():
    effects = (
        make_effect("charge_loss", {"q": 1e-5}), Wide({"var": 0.1, "frac": 0.1}),
        Shade({"dt": 3.0}), Rough({"amp": 0.02}), Bent({"b": 1e-6}), Tail({"amp": 1e-8}),
    )  # fmt: skip
    light = photons(30_000, full=True)
    images = []
    for cuts, threads in (((), 1), ((1, 17, 9000, 9000, 22_222), 1), ((12_345,), 2)):
        sensor = sensor_with(
            *effects, layout=LAYOUT, conditions={"seconds": 10.0}, threads=threads
        )
        image = blank()
        for n, (lo, hi) in enumerate(zip((0, *cuts), (*cuts, 30_000), strict=True)):
            sensor.accumulate(
                part(light, lo, hi), image, galsim.PositionI(11, 11), resume=n > 0
            )
        images.append(image.array)
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[2])
    none = draw(sensor_with(), light)
    assert np.abs(images[0] - none).max() > 100


def test_wavelength_of_the_exposure_counts():
    plain = areas_of(sensor_with(), single(5e4))
    effect = Coloured({"kappa": 0.2})
    with pytest.warns(galsim.GalSimWarning, match="bf_chromatic change nothing at 620 nm"):
        idle = sensor_with(effect)
    np.testing.assert_array_equal(areas_of(idle, single(5e4)), plain)
    red = areas_of(sensor_with(effect, conditions={"wavelength": 950.0}), single(5e4))
    # All shifts by 1.2; areas are quadratic in them, by 1 % of the change.
    assert (red - 1)[10, 10] / (plain - 1)[10, 10] == pytest.approx(1.2, abs=0.01)


def test_an_example_of_a_report(tmp_path):
    """The way from a diagnosis to images, as the README has it."""
    report = write_report(tmp_path / "report.json", [entry("charge_loss", q=1e-5)])
    sensor = BrighterFatterSensor(effects=report, rng=galsim.BaseDeviate(5))
    star = galsim.Gaussian(sigma=0.3, flux=1e5)
    image = star.drawImage(nx=25, ny=25, scale=0.2, method="phot", sensor=sensor,
                           rng=galsim.BaseDeviate(6))  # fmt: skip
    assert 0.9e5 < image.array.sum() < 0.985e5
    assert image.added_flux == pytest.approx(image.array.sum())
