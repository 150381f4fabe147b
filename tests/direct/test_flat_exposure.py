"""Flats of the direct simulation: conserved, repeatable, and relaxed by brighter-fatter feedback."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.direct.flat_exposure import FlatPlan, periodic_covariances, simulate_flat
from bfsensor.direct.transport import Transport
from bfsensor.errors import DeviceError


def plan(**changes):
    values = {
        "device": Device.load("e2v_ccd250"), "level": 20_000.0, "steps": 3, "pixels": 5,
        "seed": 600, "transport": Transport(diffusion=0.0),
    }  # fmt: skip
    return FlatPlan(**{**values, **changes})


@pytest.fixture(scope="module")
def flat():
    return simulate_flat(plan(), 0)


@pytest.mark.slow
def test_electrons_are_conserved_and_poisson(flat):
    assert flat.on[-1].sum() == flat.off[-1].sum()
    assert abs(flat.off[-1].sum() - 500_000) < 5 * np.sqrt(500_000)
    assert 0.3 < flat.off[-1].var() / 20_000 < 2.2  # chi-square of 24
    assert (np.diff(flat.on, axis=0, prepend=0) >= 0).all()


@pytest.mark.slow
def test_pixels_that_are_ahead_fall_behind(flat):
    """A pixel loses half the level times the sum of a_ij times the charges ahead of the mean.

    Diffusion is switched off: its noise would hide the loss in so few pixels.
    """
    off = flat.off[-1].astype(float)
    ahead = off - off.mean()
    change = flat.on[-1] - off
    # Table of E2V: a_00 -2.2e-6, y neighbours 3.5e-7, x neighbours 8e-8 per electron.
    response = (
        -2.2e-6 * ahead
        + 3.5e-7 * (np.roll(ahead, 1, 0) + np.roll(ahead, -1, 0))
        + 8e-8 * (np.roll(ahead, 1, 1) + np.roll(ahead, -1, 1))
    )
    expected = 0.5 * 20_000 * response
    slope = (change * expected).sum() / (expected**2).sum()
    noise = np.sqrt(((change - slope * expected) ** 2).mean() / (expected**2).sum())
    assert abs(slope - 1) < 4 * noise + 0.1
    assert slope > 5 * noise


def test_the_same_plan_gives_the_same_bits():
    few = plan(level=500.0, steps=2)
    a, b = simulate_flat(few, 3), simulate_flat(few, 3)
    other = simulate_flat(few, 4)
    assert np.array_equal(a.on, b.on) and np.array_equal(a.off, b.off)
    assert not np.array_equal(a.off, other.off)
    assert few.key != plan().key
    # Light falls on all pixels alike: a chi-square of 2 x 25 Poisson counts, 5 sigma.
    counts = np.stack([a.off[-1], other.off[-1]])
    assert abs(((counts - 500.0) ** 2 / 500.0).sum() - 50) < 5 * np.sqrt(2 * 50)


def test_covariances_of_periodic_images():
    rng = np.random.default_rng(601)
    images = rng.poisson(1000, (3, 5, 7))
    found = periodic_covariances(images)
    d = images - images.mean((1, 2), keepdims=True)
    for j, i in ((0, 0), (1, 0), (2, 3), (-1, 2)):
        plain = (d * np.roll(d, (-j, -i), (1, 2))).mean((1, 2))
        np.testing.assert_allclose(found[:, j, i], plain, atol=1e-8)
    assert np.abs(found.sum((1, 2))).max() < 1e-8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"level": 0.0}, "level = 0.0 must be from 1"),
        ({"pixels": 6}, "pixels = 6 must be odd"),
        ({"depth": 1.0}, "depth = 1.0 must be from 2 to 100"),
    ],
)
def test_refuses_impossible_plans(change, message):
    with pytest.raises(DeviceError, match=message):
        plan(**change)
