"""Adaptive moments against closed forms and quadrature, and their errors against scatter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ndtr

from bfsensor.errors import MeasurementError
from bfsensor.measure.spot_model import Shape, integrate_gaussian
from bfsensor.measure.spot_moments import SpotMoments, measure_moments
from bfsensor.measure.spots import Stamps

NAMES = ("centre_x", "centre_y", "xx", "xy", "yy", "flux")


def sample(matrix, x, y, flux, size=33):
    """A Gaussian at the pixels' middles, not integrated: sums are integrals to 1e-9."""
    u = np.arange(size) - size // 2
    dx, dy = u - x, (u - y)[:, None]
    (xx, xy), (_, yy) = matrix
    det = xx * yy - xy * xy
    return (
        flux
        / (2 * np.pi * np.sqrt(det))
        * np.exp(-0.5 * (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / det)
    )


@pytest.mark.parametrize(
    "matrix",
    [[[4.0, 0.0], [0.0, 4.0]], [[3.0, 0.8], [0.8, 5.0]], [[4.0, -1.0], [-1.0, 3.0]]],
)
def test_a_sampled_gaussian_has_its_own_moments(matrix):
    found = measure_moments(Stamps([sample(matrix, 0.3, -0.4, 1e5)]))
    (xx, xy), (_, yy) = matrix
    for name, truth in zip(NAMES, (0.3, -0.4, xx, xy, yy, 1e5), strict=True):
        # Aliases of the sum fall as exp(-2 pi^2 x smallest variance of weight times light).
        assert getattr(found, name)[0] == pytest.approx(truth, rel=2e-7, abs=2e-7)


@pytest.mark.parametrize("width", [1.5, 2.0, 3.0])
def test_an_integrated_gaussian_has_the_moments_of_the_continuous_equation(width):
    # Along one axis: the box-convolved profile with its adaptive weight, by quadrature.
    def profile(u):
        return ndtr((u + 0.5) / width) - ndtr((u - 0.5) / width)

    def excess(moment):
        def weighted(power):
            return quad(
                lambda u: u**power * np.exp(-0.5 * u * u / moment) * profile(u),
                0,
                12 * width,
            )[0]

        return weighted(2) / weighted(0) - 0.5 * moment

    expected = brentq(excess, 0.5 * width**2, 2 * width**2, xtol=1e-13)
    assert expected != pytest.approx(width**2, rel=1e-3)
    spots = 1e5 * integrate_gaussian([0.2], [0.4], Shape(width, width), int(12 * width) | 1)
    found = measure_moments(Stamps(spots))
    # Aliases: 2 exp(-pi^2 width^2) x width^2, 1e-9 at 1.5.
    assert found.xx[0] == pytest.approx(expected, rel=1e-7)
    assert found.yy[0] == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize(("width", "found"), [(1.0, 1.0010), (2.0, 2.0001)])
def test_mean_widths_have_the_offset_that_they_state(width, found):
    x, y = np.random.default_rng(8).uniform(-0.5, 0.5, (2, 400))
    spots = 1e5 * integrate_gaussian(x, y, Shape(width, width), 21)
    widths = measure_moments(Stamps(spots)).mean_widths()
    assert widths.sigma_x == pytest.approx(found, abs=1e-4)
    assert widths.sigma_y == pytest.approx(found, abs=1e-4)


def test_errors_are_the_scatter_of_mocks():
    mocks, shape = 1500, Shape(1.2, 1.5, 0.2)
    mean = 5e4 * integrate_gaussian([0.2], [-0.3], shape, 13) + 40.0
    rng = np.random.default_rng(55)
    data = rng.poisson(mean, (mocks, 13, 13)) + rng.normal(0.0, 6.0, (mocks, 13, 13))
    found = measure_moments(Stamps(data), background=40.0, read_noise=6.0)
    clean = measure_moments(Stamps(mean), background=40.0)
    assert found.used.all()
    for name in NAMES:
        values, errors = getattr(found, name), getattr(found, f"{name}_error")
        # A standard deviation of 1500 is good to 1.8 %.
        assert values.std() == pytest.approx(errors.mean(), rel=0.055)
        # Second order in the noise is 1 / 5e4; the mean is good to 0.026 of the error.
        assert abs(values.mean() - getattr(clean, name)[0]) < 0.1 * errors.mean()
    widths = found.mean_widths()
    scatter = found.xx.std(ddof=1) / np.sqrt(mocks) / (2 * widths.sigma_x)
    assert widths.sigma_x_error == pytest.approx(scatter, rel=0.055)
    known = measure_moments(
        Stamps(data, variance=np.broadcast_to(mean + 36.0, data.shape)), background=40.0
    )
    assert np.allclose(known.xx, found.xx, rtol=1e-12)
    assert known.xx_error.mean() == pytest.approx(found.xx_error.mean(), rel=0.01)


@pytest.mark.parametrize("pixel", [(6, 6), (5, 8), (8, 3)])
def test_errors_are_the_derivatives_by_each_pixel(pixel):
    spot = 5e4 * integrate_gaussian([0.2], [-0.3], Shape(1.2, 1.5, 0.2), 13)
    # All the noise is in one pixel.
    variance = np.full_like(spot, 1e-30)
    variance[0, *pixel] = 1.0
    step = np.zeros_like(spot)
    step[0, *pixel] = 0.1
    found = measure_moments(Stamps(spot, variance=variance))
    high, low = (measure_moments(Stamps(one)) for one in (spot + step, spot - step))
    for name in NAMES:
        slope = (getattr(high, name)[0] - getattr(low, name)[0]) / 0.2
        # Second order: (0.1 / 5e4)^2; moments rest to 1e-10.
        assert getattr(found, f"{name}_error")[0] == pytest.approx(
            abs(slope), rel=1e-4, abs=1e-9
        )


def test_background_left_in_widens_by_as_much_as_stated():
    spots = 1e5 * integrate_gaussian([0.0], [0.0], Shape(1.0, 1.0), 9)
    left = measure_moments(Stamps(spots + 0.001 * spots.max())).mean_widths().sigma_x
    clean = measure_moments(Stamps(spots)).mean_widths().sigma_x
    assert left / clean - 1 == pytest.approx(0.004, abs=0.002)


def test_spots_without_moments_say_why():
    spots = 1e5 * integrate_gaussian([0.1] * 5, [0.0] * 5, Shape(1.0, 1.0), 9)
    good = np.ones(spots.shape, bool)
    good[1, 0, 0] = False
    spots[2] = 0.0
    spots[3] = np.arange(81.0).reshape(9, 9)
    spots[4] *= 2e-4  # 20 electrons beside a read noise of 10
    found = measure_moments(Stamps(spots, good), read_noise=10.0)
    assert found.status.tolist()[:3] == ["used", "masked", "diverged"]
    assert found.status.tolist()[3:] == ["diverged", "faint"]
    assert np.isnan(found.xx[1:]).all()
    assert np.isfinite(found.xx[0])
    assert found.mean_widths().sigma_x == pytest.approx(1.0, abs=0.01)
    none = measure_moments(Stamps(spots[2:3]))
    with pytest.raises(MeasurementError, match="none of 1 spots has moments"):
        none.mean_widths()


def test_files_give_back_what_was_written(tmp_path):
    spots = 1e5 * integrate_gaussian([0.1, 0.2], [0.0, 0.3], Shape(1.0, 1.1), 9)
    spots[1] = 0.0
    found = measure_moments(Stamps(spots, x=np.array([7, 8]), y=np.array([70, 80])))
    found.write(tmp_path / "moments.ecsv")
    again = SpotMoments.read(tmp_path / "moments.ecsv")
    assert again == found
    assert again.xx.tobytes() == found.xx.tobytes()
    assert measure_moments(Stamps(spots)) != found


def test_wrong_arguments_are_refused():
    stamps = Stamps(np.ones((3, 9, 9)))
    with pytest.raises(MeasurementError, match=r"background has the shape \(2,\)"):
        measure_moments(stamps, background=[1.0, 2.0])
    with pytest.raises(MeasurementError, match=r"read_noise = -1.0 e-"):
        measure_moments(stamps, read_noise=-1.0)
