"""Growth of spots drawn twice: known ratios come back, with honest errors."""

import numpy as np
import pytest

from bfsensor.errors import MeasurementError
from bfsensor.measure.growth import measure_growth
from bfsensor.measure.spot_model import Shape, integrate_gaussian

PEAKS = np.array([20e3, 60e3, 120e3])
SLOPE = (0.7, 0.9)  # % per 50,000 e-


def draw(spots, seed, noise=True, slope=SLOPE):
    """Spots of 1 pixel with common photons: growth moves few of them."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.5, 0.5, (2, spots))
    share = float(integrate_gaussian([0.0], [0.0], Shape(1.0, 1.0), 1)[0, 0, 0])
    on, off = [], []
    for peak in PEAKS:
        wide = Shape(*(1 + 0.01 * s * peak / 5e4 for s in slope))
        plain = peak / share * integrate_gaussian(x, y, Shape(1.0, 1.0), 13)
        grown = peak / share * integrate_gaussian(x, y, wide, 13)
        common = rng.poisson(plain) - plain if noise else 0.0
        # Photons that moved are drawn again: their number is the variance of the difference.
        moved = rng.normal(0, np.sqrt(np.abs(grown - plain) + 1e-9)) if noise else 0.0
        off.append(plain + common)
        on.append(grown + common + moved)
    return np.array(on).swapaxes(0, 1), np.array(off).swapaxes(0, 1)


@pytest.mark.parametrize("weights", ["equal", "noise"])
def test_exact_spots_give_the_exact_growth(weights):
    found = measure_growth(*draw(5, 900, noise=False), weights=weights)
    expected = PEAKS[:, None] / 5e4 * np.array(SLOPE)
    np.testing.assert_allclose(found.growth, expected, rtol=2e-3)
    np.testing.assert_allclose(found.slope, SLOPE, rtol=2e-3)
    np.testing.assert_allclose(found.peak, PEAKS, rtol=1e-3)
    assert found.slope_error.max() < 1e-3 and found.spots == 5


def test_no_growth_is_none():
    on, _ = draw(4, 901)
    found = measure_growth(on, on)
    assert not found.growth.any() and not found.slope.any()


@pytest.mark.slow
def test_errors_are_those_of_the_scatter():
    """Pulls of 60 slopes: mean 0, width 1."""
    runs = [measure_growth(*draw(8, seed)) for seed in range(3000, 3060)]
    pulls = np.array([(r.slope - SLOPE) / r.slope_error for r in runs])
    # Jackknife errors of 8 spots scatter by 1 / sqrt(14): Student's t of 7, width 1.18.
    assert np.abs(pulls.mean(0)).max() < 4 * 1.18 / np.sqrt(len(runs))
    assert (pulls.std(0) > 0.8).all() and (pulls.std(0) < 1.6).all()
    # Common photons: a tenth of the error that either image has by itself.
    assert np.mean([r.slope_error for r in runs]) < 0.03


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((1, 2, 9, 9), {}, "^1 spots"),
        ((3, 9, 9), {}, "must both be"),
        ((3, 2, 9, 9), {"stamp": 8}, "stamp = 8 must be odd"),
        ((3, 2, 9, 9), {"stamp": 11}, "stamp = 11 must be odd, from 3 to the side"),
    ],
)
def test_refuses_what_does_not_fit(shape, options, message):
    with pytest.raises(MeasurementError, match=message):
        measure_growth(np.ones(shape), np.ones(shape), **options)
