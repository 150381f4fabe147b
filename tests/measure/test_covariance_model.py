"""The series against the published equation, against the differential equation, and itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import convolve2d

from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import image_weights, unfold
from bfsensor.measure.covariance_model import expand, model_covariances


def make_a(lags=3, seed=31):
    rng = np.random.default_rng(seed)
    j, i = np.indices((lags + 1, lags + 1))
    a = 4e-7 / np.maximum(i**2 + j**2, 1) ** 1.5 * (1 + 0.5 * rng.random(i.shape))
    a[1, 0] *= 1.5
    a[0, 0] = 0.0
    a[0, 0] = -(image_weights(lags) * a).sum()
    return a


def astier_equation_20(mu, a, c, noise, gain):
    """Equation 20 of Astier et al. 2019 as the pipelines code it, by direct convolution.

    C = (m / g^2) [a m + 2/3 (a x a + c) m^2 + (1/3 a x a x a + 5/6 a x c) m^3] + n / g^2,
    and mu / g more at (0, 0); m = g mu.
    """
    lags = a.shape[0] - 1
    aa = convolve2d(unfold(a), unfold(a))
    aaa = convolve2d(aa, unfold(a))
    ac = convolve2d(unfold(a), unfold(c))

    def quadrant(plane):
        middle = plane.shape[0] // 2
        return plane[middle : middle + lags + 1, middle : middle + lags + 1]

    m = gain * mu
    second = 2 / 3 * (quadrant(aa) + c)
    third = quadrant(aaa) / 3 + 5 / 6 * quadrant(ac)
    out = m / gain**2 * (a * m + second * m**2 + third * m**3) + noise / gain**2
    out[0, 0] += mu / gain
    return out


@pytest.mark.parametrize("lags", [1, 3, 8])
def test_four_powers_are_the_published_equation(lags):
    a = make_a(lags)
    b = 1e-6 * np.random.default_rng(32).standard_normal(a.shape)
    noise = np.full(a.shape, 3.0)
    found = model_covariances([9e4 / 1.7], a, b=b, noise=noise, gain=1.7, powers=4)
    expected = astier_equation_20(9e4 / 1.7, a, a * b, noise, 1.7)
    np.testing.assert_allclose(found[0], expected, rtol=1e-11)


def integrate_modes(level, a, c):
    """dC/dm = 1 + 2 (a + c m) C in every mode of a torus, by Runge and Kutta."""
    n = 48
    lags = a.shape[0] - 1
    at = np.arange(-lags, lags + 1)
    modes = []
    for quadrant in (a, c):
        plane = np.zeros((n, n))
        plane[at[:, None], at[None]] = unfold(quadrant)
        modes.append(np.fft.fft2(plane).real.ravel())
    found = solve_ivp(
        lambda m, y: 1 + 2 * (modes[0] + modes[1] * m) * y, (0, level), np.zeros(n * n),
        rtol=1e-10, atol=1e-6, method="DOP853",
    )  # fmt: skip
    plane = np.fft.ifft2(found.y[:, -1].reshape(n, n)).real
    return plane[: lags + 1, : lags + 1]


def test_the_series_converges_to_the_differential_equation():
    a = make_a()
    c = a * 4e-7
    level = 1.2e5
    exact = integrate_modes(level, a, c)
    errors = []
    for powers in (3, 4, 5, 6, 8, 10):
        found = model_covariances([level], a, b=c / a, powers=powers)[0]
        errors.append(np.abs(found - exact).max() / level)
    strength = abs(a[0, 0]) * level
    assert 0.2 < strength < 0.5
    # Each power gains a factor of about a m; the published four leave 1e-3 here.
    assert np.all(np.diff(np.log(errors)) < np.log(0.6))
    assert 1e-4 < errors[1] < 1e-2
    assert errors[4] < 5e-6
    # Round-off and the integrator's tolerance.
    assert errors[5] < 1e-7


def test_poisson_without_effect():
    found = model_covariances([1e3, 5e4], np.zeros((3, 3)), gain=2.0)
    np.testing.assert_allclose(found[:, 0, 0], [500.0, 25_000.0])
    assert np.all(found[:, 1:] == 0)


def test_charge_is_conserved():
    """The sum over the plane is the level where the sum of a is zero, whatever the order."""
    a = make_a(2)
    lags = 2 * 8
    wide = np.pad(a, (0, lags - 2))
    found = model_covariances([8e4], wide, powers=8)[0]
    assert (image_weights(lags) * found).sum() == pytest.approx(8e4, rel=1e-9)


@pytest.mark.parametrize("powers", [2, 4, 8])
def test_slopes_by_differences(powers):
    a, rng = make_a(2), np.random.default_rng(33)
    c = a * 1e-6 * rng.random(a.shape)
    m = np.array([3e4, 1e5])
    series = expand(a, c, powers, slopes=True)
    for which, slopes, step in (("a", series.by_a, 1e-9), ("c", series.by_c, 1e-14)):
        slope = np.tensordot(series.monomials(m), slopes, 1)
        for lag in range(a.size):
            shift = np.zeros(a.size)
            shift[lag] = step
            shift = shift.reshape(a.shape)
            ends = [
                expand(
                    a + s * shift * (which == "a"), c + s * shift * (which == "c"), powers
                ).at(m)
                for s in (1, -1)
            ]
            expected = ((ends[0] - ends[1]) / (2 * step)).reshape(2, -1)
            scale = np.abs(slope).max()
            np.testing.assert_allclose(slope[:, :, lag], expected, atol=1e-6 * scale)


def test_refusals():
    with pytest.raises(MeasurementError, match="gain = 0 e-/unit must be above 0"):
        model_covariances([1e4], np.zeros((2, 2)), gain=0)
    with pytest.raises(MeasurementError, match="powers = 20 must be from 1 to 12"):
        model_covariances([1e4], np.zeros((2, 2)), powers=20)
