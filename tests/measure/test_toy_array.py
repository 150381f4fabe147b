"""Arrays of pixels with linear areas: closed form, dense equations, series, darts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import convolve2d

from bfsensor._kernels import toy as kernels
from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import unfold
from bfsensor.measure.toy import measure_pair, predict_pair
from bfsensor.measure.toy_array import (
    close_sum,
    measure_array,
    predict_array,
    throw_at_array,
)

# The shape of a real a-matrix [j, i], larger along y; its sum is closed by a ring.
SHAPE = close_sum(unfold([[-1.0, 0.12], [0.24, 0.05]]))


def random_lags(seed, *, scale):
    """Lags of both signs without any symmetry."""
    a = np.random.default_rng(seed).uniform(-1, 1, (3, 5))
    a[1, 2] -= 3
    a[0, 0] -= a.sum()
    return scale * a


def wrap(a, size):
    """Lags on a periodic array, (0, 0) first."""
    ny, nx = a.shape
    wide = np.pad(a, ((0, size - ny), (0, size - nx)))
    return np.roll(wide, (-(ny // 2), -(nx // 2)), (0, 1))


def dense_covariances(a, level, size):
    """dC/dmu = 1 + A C + C A^T for all pairs of pixels, by Runge-Kutta; of pixel (0, 0)."""
    count = size**2
    matrix = np.zeros((count, count))
    ny, nx = a.shape
    for y, x in np.ndindex(size, size):
        for j, i in np.ndindex(ny, nx):
            gains = (y + j - ny // 2) % size * size + (x + i - nx // 2) % size
            matrix[gains, y * size + x] += a[j, i]

    def slope(_, c):
        c = c.reshape(count, count)
        return (np.eye(count) + matrix @ c + c @ matrix.T).ravel()

    end = solve_ivp(
        slope, (0, level), np.zeros(count**2), rtol=1e-10, atol=1e-9, method="DOP853"
    )
    return end.y[:, -1].reshape(count, count)[0].reshape(size, size)


@pytest.mark.parametrize("a", [SHAPE * 1e-3, random_lags(55, scale=1e-4)])
def test_the_closed_form_solves_the_equations_of_all_pairs(a):
    found = predict_array(a, 600.0, size=5)
    assert found == pytest.approx(dense_covariances(a, 600.0, 5), abs=1e-6)
    assert abs(found[0, 0] - 600.0) > 50


def test_the_series_is_astier_s():
    # Astier et al. 2019, eq. 20, with b = 0, on the infinite plane.
    second = convolve2d(SHAPE, SHAPE)
    third = convolve2d(second, SHAPE)
    remainders = []
    for level in (0.04, 0.08):
        series = np.zeros((32, 32))
        series[0, 0] = level
        for order, term in ((2, SHAPE), (3, 2 / 3 * second), (4, third / 3)):
            series += level**order * wrap(term, 32)
        # The model ends where areas close, the formula does not: only a times level counts.
        found = predict_array(SHAPE * 1e-6, level * 1e6, size=32) / 1e6
        remainders.append(np.abs(found - series).max())
    # The next term is 2/15 a^4 level^5, with a^4 at most (sum of |a|)^4 = 2^4 here.
    assert remainders[1] < 2 / 15 * 2**4 * 0.08**5
    assert remainders[1] / remainders[0] == pytest.approx(2**5, rel=0.15)


def test_first_order_sits_at_its_lag():
    a = random_lags(812, scale=1e-9)
    c = predict_array(a, 1000.0, size=16)
    # A flat sees the mean of opposite lags; a[reach_y + j, reach_x + i].
    assert c[0, 2] == pytest.approx(1e6 * (a[1, 4] + a[1, 0]) / 2, rel=1e-4)
    assert c[1, 0] == pytest.approx(1e6 * (a[2, 2] + a[0, 2]) / 2, rel=1e-4)
    assert c[1, -2] == pytest.approx(1e6 * (a[2, 0] + a[0, 4]) / 2, rel=1e-4)
    assert c[-1, 2] == pytest.approx(c[1, -2], rel=1e-9)


@pytest.mark.parametrize("level", [0.0, 10.0, 900.0])
def test_nothing_is_lost(level):
    # The sum of all covariances is the Poisson variance: charge only moves between pixels.
    assert predict_array(SHAPE * 1e-3, level).sum() == pytest.approx(level, rel=1e-12)
    charges = throw_at_array(SHAPE * 1e-3, level, size=8, realisations=3, seed=97)
    again = throw_at_array(SHAPE * 0.0, level, size=8, realisations=3, seed=97)
    assert np.array_equal(charges.sum(axis=(1, 2)), again.sum(axis=(1, 2)))


def test_an_array_of_two_pixels_is_the_pair():
    alpha, level, realisations = 2e-3, 100.0, 40_000
    partners, weights = np.array([[0, 1], [1, 0]]), np.array([-alpha, alpha])
    darts = np.random.default_rng(15).poisson(2 * level, realisations)
    charges = np.empty((realisations, 2), np.int32)
    kernels.throw_array(partners, weights, darts, np.uint32(77), np.uint32(78), charges)
    measured, errors = measure_pair(charges)
    theory = predict_pair(alpha, level)
    assert abs(measured.variance - theory.variance) < 4.4 * errors.variance
    assert abs(measured.covariance - theory.covariance) < 4.4 * errors.covariance
    assert theory.covariance > 20 * errors.covariance


# -- darts ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "seed"), [(SHAPE * 2e-3, 20_117), (random_lags(4, scale=4e-4), 5183)]
)
def test_darts_obey_the_closed_form(a, seed):
    level, realisations = 200.0, 2500
    charges = throw_at_array(a, level, size=6, realisations=realisations, seed=seed)
    assert charges.mean() == pytest.approx(level, abs=5 * np.sqrt(level / charges.size))
    # Modes are independent: of a Gaussian mode the power has the error of its mean over
    # sqrt(realisations), sqrt(2) more where the mode is its own mirror image.
    power = (np.abs(np.fft.fft2(charges - level)) ** 2).mean(axis=0) / 36
    theory = np.fft.fft2(predict_array(a, level, size=6)).real
    mirror = np.arange(6)[:, None] * 6 + np.arange(6)
    other = (-np.arange(6) % 6)[:, None] * 6 + -np.arange(6) % 6
    pull = (power / theory - 1) * np.sqrt(realisations / (1 + (mirror == other)))
    once = mirror <= other
    # 20 modes: chi-square has the mean 20 and the error sqrt(40).
    assert once.sum() == 20
    assert (pull[once] ** 2).sum() < 20 + 4 * np.sqrt(40)
    measured, errors = measure_array(charges, level)
    assert np.abs((measured - predict_array(a, level, size=6)) / errors).max() < 4.4
    # Neither no effect nor the first order alone would pass.
    flat = np.zeros((6, 6))
    flat[0, 0] = level
    assert np.abs((measured - flat) / errors).max() > 20
    first = flat + level**2 * wrap((a + a[::-1, ::-1]) / 2, 6)
    assert np.abs((measured - first) / errors).max() > 10


def test_darts_know_x_from_y():
    a = np.array([[1e-3, -2e-3, 1e-3]])
    charges = throw_at_array(a, 100.0, size=5, realisations=1500, seed=661)
    measured, errors = measure_array(charges, 100.0)
    assert measured[0, 1] > 8 * errors[0, 1]
    assert abs(measured[1, 0]) < 4 * errors[1, 0]


def test_fewer_arrays_are_the_first_of_more():
    many = throw_at_array(SHAPE * 1e-3, 30.0, size=7, realisations=9, seed=4242)
    few = throw_at_array(SHAPE * 1e-3, 30.0, size=7, realisations=4, seed=4242)
    assert np.array_equal(many[:4], few)


def test_measured_covariances_are_sums_over_pixels():
    charges = np.random.default_rng(19).poisson(50.0, (3, 4, 5))
    measured, errors = measure_array(charges, 50.0)
    d = charges - 50.0
    for j, i in np.ndindex(4, 5):
        each = (d * np.roll(d, (-j, -i), (1, 2))).mean(axis=(1, 2))
        assert measured[j, i] == pytest.approx(each.mean(), abs=1e-9)
        assert errors[j, i] == pytest.approx(each.std(ddof=1) / np.sqrt(3), abs=1e-9)


# -- a-matrices ----------------------------------------------------------------------------


def test_the_ring_takes_what_is_missing():
    a = unfold([[-5.0, 0.5], [0.5, 0.2]])
    closed = close_sum(a)
    assert closed.shape == (5, 5)
    assert closed.sum() == pytest.approx(0, abs=1e-14)
    assert np.array_equal(closed[1:-1, 1:-1], a)
    # -5 + 4 * 0.5 + 4 * 0.2 = -2.2, shared by 16.
    assert closed[0] == pytest.approx(2.2 / 16)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: predict_array([[-1.0, 1.0]], 1.0), r"shape \(1, 2\): two axes of odd"),
        (
            lambda: predict_array([[-1.0, 0.5, 0.4]], 1.0),
            r"sums to -0.1 1/e-; it must sum to 0",
        ),
        (lambda: predict_array([[0.0, np.nan, 0.0]], 1.0), r"must be finite"),
        (lambda: predict_array(SHAPE, 1.0, size=4), r"size = 4 pixels must be from 5"),
        (lambda: predict_array(SHAPE * 1e-3, -1.0), r"level = -1.0 e- must be from 0"),
        (
            lambda: predict_array(SHAPE * 0.2, 50.0),
            r"areas change by 0\.\d+ rms, above 0.2",
        ),
        (lambda: predict_array(-SHAPE, 1e6), r"areas change by .* rms, above 0.2"),
        (
            lambda: throw_at_array(SHAPE * 0.6, 50.0, size=5, realisations=9, seed=2),
            r"areas went from -?\d\.\d+ to \d\.\d+ of the pixel",
        ),
        (
            lambda: throw_at_array(SHAPE * 1e-9, 1e8, size=64, realisations=9, seed=2),
            r"4.096e\+11 electrons in all must be from 0 to 2e\+09",
        ),
        (lambda: close_sum(np.zeros((2, 3))), r"shape \(2, 3\): two axes of odd"),
        (
            lambda: measure_array(np.zeros((1, 4, 4)), 0.0),
            r"shape \(1, 4, 4\); \(2 or more",
        ),
    ],
)
def test_refusals(call, message):
    with pytest.raises(MeasurementError, match=message):
        call()
