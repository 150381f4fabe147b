"""The response fitted to flats: exact on linear flats, as wide as its noise says, off at zero."""

import numpy as np
import pytest

from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import unfold
from bfsensor.measure.pixel_response import measure_response
from bfsensor.measure.toy_array import close_sum

QUADRANT = np.array([[-2e-6, 1.5e-7, 2e-8], [3e-7, 5e-8, 1e-8], [4e-8, 1e-8, 0.0]])


def grow(strength, *, size=13, steps=5, level=80_000, noise=0.0, seed=1):
    """Flats whose areas follow the charge of the middle of each step."""
    rng = np.random.default_rng(seed)
    a = np.zeros((size, size))
    lags = close_sum(unfold(strength * QUADRANT))
    reach = len(lags) // 2
    a[: len(lags), : len(lags)] = lags
    a = np.roll(a, (-reach, -reach), (0, 1))
    spectrum = np.fft.fft2(a)
    off = np.cumsum(rng.poisson(level / steps, (steps, size, size)), axis=0).astype(float)
    on, charge, before = np.empty_like(off), np.zeros((size, size)), 0.0
    for k in range(steps):
        came = off[k] - before
        held = charge + 0.5 * came
        moved = came.mean() * np.fft.ifft2(spectrum * np.fft.fft2(held)).real
        moved += noise * rng.normal(size=moved.shape)
        charge = charge + came + moved
        before = off[k]
        on[k] = charge
    return on, off, a


def test_linear_flats_give_their_a_matrix():
    on, off, a = grow(1.0)
    found = measure_response(on, off)
    assert found.shape == (7, 7)
    np.testing.assert_allclose(found, a[:7, :7], rtol=1e-6, atol=1e-13)


def test_no_effect_gives_nothing():
    on, off, _ = grow(0.0)
    assert np.abs(measure_response(on, off)).max() < 1e-14


def test_noise_averages_out():
    pulls = []
    for seed in range(12):
        on, off, a = grow(1.0, noise=2.0, seed=seed)
        pulls.append(measure_response(on, off)[:2, :2] - a[:2, :2])
    mean, error = np.mean(pulls, 0), np.std(pulls, 0, ddof=1) / np.sqrt(12)
    assert (np.abs(mean) < 4 * error).all()
    assert (error < 0.1 * np.abs(a[:2, :2])).all()


@pytest.mark.parametrize(
    ("on", "off", "message"),
    [
        (np.zeros((3, 5, 5)), np.zeros((2, 5, 5)), "of the shapes"),
        (np.zeros((5, 5)), np.zeros((5, 5)), "of the shapes"),
        (np.full((1, 5, 5), np.nan), np.zeros((1, 5, 5)), "not finite"),
    ],
)
def test_refuses_what_is_no_flat(on, off, message):
    with pytest.raises(MeasurementError, match=message):
        measure_response(on, off)
