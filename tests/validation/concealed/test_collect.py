"""Collection against closed forms that share nothing with it."""

import numpy as np
import pytest
from scipy.special import erf

import validation.concealed.collect as collect_module
from tests.validation.concealed.twins import covariances, electrons, flat_power, image
from validation.concealed.card import NOMINAL, shifts_at
from validation.concealed.collect import (
    Response,
    _gather_spots,
    _still,
    collect,
    counts,
    spill,
    steps_for,
)
from validation.concealed.plan import Geometry, Size, exposures_of
from validation.concealed.scene import Scene, spot_scene
from validation.concealed.sensor import VirtualSensor

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


def test_fringes_are_evened_out_by_their_charge():
    """Stored contrast of a wave in the light, against (exp(x) - 1) / x with x = a(k) times the level."""
    pixels, mu, period = 64, 6e4, 8
    response = Response.of(SHIFTS, pixels)
    wave = np.cos(2 * np.pi * np.arange(pixels) / period)[None, :]
    light = (mu * (1 + 0.01 * wave) * np.ones((pixels, 1))).astype(np.float32)
    scene = Scene(light, even=np.full_like(light, mu))
    rng, stored = np.random.default_rng(5152), 0.0
    for _ in range(40):
        stored = stored + collect(scene, response, rng).astype(float) / 40
    contrast = 2 * (stored * wave).mean() / mu
    a = SHIFTS.area_changes()
    at = np.arange(len(a)) - len(a) // 2
    x = float((a.sum(axis=0) * np.cos(2 * np.pi * at / period)).sum() * mu)
    error = np.sqrt(2 / (mu * pixels**2 * 40))
    assert contrast == pytest.approx(0.01 * np.expm1(x) / x, abs=4 * error)
    assert 0.01 - contrast > 6 * error


def _power_of_steps(monkeypatch, mu, steps, pixels=32):
    """Power of a flat without chance: the end's response to one more charge in each step."""
    response, extra = Response.of(SHIFTS, pixels), 2e4  # far above the rounding of float32
    power = 0.0
    for born in range(steps):
        ends = []
        for more in (0.0, extra):
            count = iter(range(steps))

            def drawn(mean, rng, more=more, count=count, born=born):
                mean = mean.copy()
                mean[0, 0] += more if next(count) == born else 0.0
                return mean

            monkeypatch.setattr(collect_module, "counts", drawn)
            ends.append(
                collect(_flat(mu, pixels), response, None, steps=steps).astype(float)
            )
        moved = np.abs(np.fft.fft2(ends[1] - ends[0])) ** 2 / extra**2
        power = power + moved * mu / steps
    return power


@pytest.mark.parametrize("mu", [6e4, 1.2e5])
def test_step_error_falls_as_the_square_and_is_small(monkeypatch, mu):
    """Over all modes the power is wrong by less than 5e-4 with the steps that are taken.

    Without the factor K^2 / (K^2 - 1) the leading order alone lacks 1 / K^2 of it, 3e-3 here.
    """
    expected = flat_power(SHIFTS.area_changes(), mu, 32)
    worst = [
        np.abs(_power_of_steps(monkeypatch, mu, k) / expected - 1)[1:, 1:].max()
        for k in (6, 12)
    ]
    assert worst[0] / worst[1] > 3
    taken = _power_of_steps(monkeypatch, mu, steps_for(mu)) / expected - 1
    assert np.abs(taken[1:, 1:]).max() < 5e-4


def test_halving_the_steps_of_spots():
    """The mean image of a bright spot with 8 and 16 steps differs by less than 1e-3 of its peak."""
    scene = spot_scene([(16.2, 15.9)], [1e6], (1.05, 1.05), 32)
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
    scene = spot_scene([(x0, y0)], [flux], (sigma, sigma), pixels)
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


def test_nulls_with_all_nuisances_follow_the_closed_form():
    """Six pairs of 128^2 at three levels, codes to electrons, pairs differenced.

    The true device's shifts, gains and noise are those of the truth; 9 lags at each level.
    """
    size = Size(128, 6, 0, dithers=0, flat_seconds=(10.0, 30.0, 60.0))
    sensor = VirtualSensor(Geometry(128, 1), seed=60606)
    flats: dict[float, list] = {}
    for e in exposures_of(size):
        taken = sensor.take(e)
        if e.kind == "FLAT":
            flats.setdefault(e.seconds, []).append(image(electrons(sensor, taken)))
    area = shifts_at(sensor.device, 620.0, -60.0).area_changes()
    gain, noise = sensor.electronics.gain[0], sensor.electronics.noise[0]
    for seconds, frames in flats.items():
        mu = sensor.lamp.flat_rate * seconds
        assert np.mean(frames) == pytest.approx(mu, rel=5e-3)
        power = 0.0
        for first, second in zip(frames[::2], frames[1::2], strict=True):
            # the lamp walks between the two of a pair
            d = (first / first.mean() - second / second.mean()) * np.mean(frames)
            power = power + np.abs(np.fft.fft2(d)) ** 2 / 2 / d.size / 6
        expected = flat_power(area, float(np.mean(frames)), 128)
        expected = expected + noise**2 + gain**2 / 12 + 0.05**2
        sigma = np.sqrt((expected**2).sum() / 6) / 128**2 * np.ones((3, 3))
        sigma[0, 0] *= np.sqrt(2)
        pull = (covariances(power) - covariances(expected)) / sigma
        assert (pull**2).sum() < 30, seconds
