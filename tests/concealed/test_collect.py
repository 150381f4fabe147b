"""Collection against closed forms that share nothing with it."""

import numpy as np
import pytest
from scipy.special import erf

from tests.concealed.twins import covariances, flat_power
from validation.concealed.card import NOMINAL, shifts_at
from validation.concealed.collect import Response, collect, counts, spill, steps_for
from validation.concealed.scene import Scene, spot_scene

SHIFTS = shifts_at(NOMINAL, 620.0, -60.0)


def _flat(mu, pixels):
    return Scene(np.full((pixels, pixels), mu, np.float32))


@pytest.mark.parametrize("mu", [2e4, 6e4, 1.2e5])
def test_null_flats_follow_the_closed_form(mu):
    """Covariances at lags 0 to 2, 40 flats of 128^2; Bartlett's errors, chi2 of 9 lags below 30."""
    pixels, flats = 128, 40
    response = Response.of(SHIFTS, pixels)
    rng = np.random.default_rng(5150)
    power = 0.0
    for _ in range(flats):
        charge = collect(_flat(mu, pixels), response, rng).astype(float) - mu
        power = power + np.abs(np.fft.fft2(charge)) ** 2 / pixels**2 / flats
    expected = flat_power(SHIFTS.area_changes(), mu, pixels)
    sigma = np.sqrt((expected**2).sum() / flats) / pixels**2 * np.ones((3, 3))
    sigma[0, 0] *= np.sqrt(2)
    pull = (covariances(power) - covariances(expected)) / sigma
    assert (pull**2).sum() < 30  # p = 4e-4
    # without the effect the same numbers are far off
    assert ((covariances(expected)[0, 0] - mu) / sigma[0, 0]) ** 2 > 400


def test_step_error_falls_as_the_square_and_is_small():
    """The response of one mode to the noise of every step, without drawing anything."""

    def error(x, steps):
        act = x * steps**2 / (steps**2 - 1) / steps
        power = 0.0
        for born in range(steps):
            now = before = 0.0
            for n in range(steps):
                grown = (
                    now
                    + (n == born)
                    + (act * (1.5 * now - 0.5 * before) if n > born else 0)
                )
                before, now = now, grown
            power += now**2 / steps
        return power / (np.expm1(2 * x) / (2 * x)) - 1

    errors = [error(-0.2, k) for k in (8, 16, 32)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)
    for mu in (2e3, 2e4, 6e4, 1.2e5):  # modes of 2 a mu from 0.1 to -1.1 at 1.2e5
        assert (
            max(abs(error(x * mu / 1.2e5, steps_for(mu))) for x in (-0.55, -0.3, 0.05))
            < 5e-4
        )


def test_halving_the_steps_of_spots():
    """The mean image of a bright spot with 8 and 16 steps differs by less than 1e-3 of its peak."""
    scene = spot_scene([(16.2, 15.9)], [1e6], 1.05, 32)
    response = Response.of(SHIFTS, 32)
    images = []
    for steps in (8, 16, 64):
        mean = np.mean(
            [
                collect(scene, response, np.random.default_rng(s), steps=steps)
                for s in range(40)
            ],
            axis=0,
        )
        images.append(mean)
    still = scene.light
    effect = np.abs(images[2] - still).max()
    noise = np.sqrt(still.max() / 40)
    assert effect > 40 * noise
    assert np.abs(images[1] - images[2]).max() < 1e-3 * still.max() + 5 * noise
    assert abs(images[1].sum() / still.sum() - 1) < 5 / np.sqrt(40 * still.sum())


def test_displaced_edges_take_the_light_between():
    """Columns displaced by up to 0.2 pixel: exact integrals by erf; the series lacks s^4."""
    pixels, sigma, x0, y0, flux = 24, 1.1, 11.3, 12.4, 1e6
    rng = np.random.default_rng(31)
    moved = np.zeros((pixels, pixels + 1), np.float32)
    moved[:, 1:-1] = rng.uniform(-0.2, 0.2, pixels - 1)[None, :]
    scene = spot_scene([(x0, y0)], [flux], sigma, pixels)
    from validation.concealed.collect import _gather_spots, _still

    none = np.zeros((pixels + 1, pixels), np.float32)
    response = Response.of(SHIFTS, pixels)
    light = _gather_spots(scene, response, None, np.float32(1), _still((moved, none)))
    edges = np.arange(pixels + 1) - 0.5

    def share(at, centre):
        return 0.5 * np.diff(erf((at - centre) / sigma / np.sqrt(2)))

    exact = flux * np.outer(share(edges, y0), share(edges + moved[0], x0))
    assert np.abs(light - exact).max() < 2e-4 * exact.max()
    assert np.abs(light - scene.light).max() > 0.05 * exact.max()
    assert light.sum() == pytest.approx(flux, rel=1e-5)


def test_flat_light_through_the_spots_path_is_a_flat():
    pixels, mu = 64, np.float32(8e4)
    response = Response.of(SHIFTS, pixels)
    flat = np.full((pixels, pixels), mu)
    sides = (flat, np.zeros_like(flat), np.zeros_like(flat))
    one = collect(Scene(flat), response, np.random.default_rng(7))
    other = collect(Scene(flat, sides, sides), response, np.random.default_rng(7))
    assert np.allclose(one, other, rtol=2e-5)


def test_counts_have_the_cumulants_of_poisson():
    """Mean, variance, third cumulant to 5 sigma at a small, a middling and a large mean."""
    rng = np.random.default_rng(17)
    for mean in (3.0, 60.0, 5e3):
        n = counts(np.full((1000, 1000), mean, np.float32), rng).astype(float) - mean
        assert abs(n.mean()) < 5 * np.sqrt(mean / n.size)
        assert abs(n.var() / mean - 1) < 5 * np.sqrt(2.4 / n.size)
        assert abs((n**3).mean() / mean - 1) < 5 * np.sqrt(15 * mean / n.size) + 0.1


def test_spill_keeps_charge_in_the_column():
    charge = np.full((30, 3), 100.0, np.float32)
    charge[15, 1] = 1000.0
    spill(charge, 200.0)
    assert charge.max() <= 200.001
    assert charge[:, 1].sum() == pytest.approx(30 * 100 + 900, rel=1e-5)
    assert np.all(charge[:, 0] == 100.0)
    assert charge[15 - 3, 1] > 100.0 and charge[15 + 3, 1] > 100.0
