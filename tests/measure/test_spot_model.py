"""The integrated Gaussian against quadrature and photons, its slopes against differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad

from bfsensor.errors import MeasurementError
from bfsensor.measure import spot_model
from bfsensor.measure.spot_model import Shape, curvatures, gradients, integrate_gaussian

SHAPES = [
    Shape(1.02, 1.05),
    Shape(0.4, 1.7),
    Shape(1.1, 0.9, 0.3),
    Shape(1.3, 1.0, -0.79),
    Shape(0.5, 0.6, 0.5),
]


def density(x, y, shape):
    """Bivariate normal density by its covariance matrix."""
    sx, sy, rho = shape
    matrix = np.array([[sx**2, rho * sx * sy], [rho * sx * sy, sy**2]])
    d = np.array([x, y])
    return np.exp(-0.5 * d @ np.linalg.solve(matrix, d)) / (
        2 * np.pi * np.sqrt(np.linalg.det(matrix))
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_pixels_agree_with_adaptive_quadrature(shape):
    x, y = 0.31, -0.22
    stamp = integrate_gaussian([x], [y], shape, (7, 9))[0]
    for j, i in ((0, 0), (1, 0), (0, 1), (2, -1), (-1, 3)):
        value, error = dblquad(
            lambda v, u: density(u - x, v - y, shape),
            i - 0.5, i + 0.5, j - 0.5, j + 0.5, epsabs=1e-12, epsrel=1e-12,
        )  # fmt: skip
        assert error < 1e-10
        assert abs(stamp[j + 3, i + 4] - value) < 2e-10


def test_ten_nodes_are_enough_up_to_the_largest_correlation(monkeypatch):
    def error(rho):
        stamps = []
        for nodes in (10, 60):
            found = np.polynomial.legendre.leggauss(nodes)
            for name, values in zip(("_NODES", "_WEIGHTS"), found, strict=True):
                monkeypatch.setattr(spot_model, name, values)
            stamps += [
                integrate_gaussian([0.3, 0.0], [-0.2, 0.0], Shape(w, w, rho), 15)
                for w in (0.4, 1.0, 3.0)
            ]
        return np.abs(np.array(stamps[:3]) - np.array(stamps[3:])).max()

    assert error(spot_model.LARGEST_CORRELATION) < 5e-10
    monkeypatch.setattr(spot_model, "LARGEST_CORRELATION", 0.9)
    assert error(0.9) > 1e-8


def test_pixels_agree_with_thrown_photons():
    shape, count = Shape(1.2, 0.8, 0.4), 2_000_000
    rng = np.random.default_rng(5512)
    xy = shape.correlation * shape.sigma_x * shape.sigma_y
    matrix = [[shape.sigma_x**2, xy], [xy, shape.sigma_y**2]]
    x, y = rng.multivariate_normal([0.2, -0.4], matrix, count).T
    edges = np.arange(8) - 3.5
    thrown = np.histogram2d(y, x, [edges, edges])[0]
    expected = count * integrate_gaussian([0.2], [-0.4], shape, 7)[0]
    # 49 pixels, all with more than 0.1 expected; chi2 of 49 is below 90 but for 3e-4.
    chi2 = np.sum((thrown - expected) ** 2 / np.maximum(expected, 1.0))
    assert chi2 < 90
    flipped = np.sum((thrown.T - expected) ** 2 / np.maximum(expected, 1.0))
    assert flipped > 1e4


@pytest.mark.parametrize("shape", SHAPES)
def test_all_light_is_somewhere(shape):
    stamp = integrate_gaussian([0.4, -0.1], [0.2, 0.0], shape, 35)
    assert np.abs(stamp.sum(axis=(1, 2)) - 1).max() < 1e-10
    assert stamp.min() > -1e-12


def test_far_tails_keep_their_digits():
    # 1 - Phi is lost at 8.3 sigma; the tail here is 6e-23.
    left = integrate_gaussian([0.0], [0.0], Shape(1.0, 1.0), (1, 21))[0, 0]
    assert np.allclose(left, left[::-1], rtol=1e-12, atol=0)
    assert 0 < left[-1] < 1e-20


@pytest.mark.parametrize("shape", SHAPES)
def test_slopes_are_those_of_differences(shape):
    x, y = np.array([0.3, -0.45]), np.array([-0.2, 0.1])
    slopes = gradients(x, y, shape, 7, 9)
    step = 1e-5

    def value(dx=0.0, dy=0.0, dsx=0.0, dsy=0.0, dr=0.0):
        moved = Shape(shape[0] + dsx, shape[1] + dsy, shape[2] + dr)
        return integrate_gaussian(x + dx, y + dy, moved, (7, 9))

    assert np.abs(slopes[0] - value()).max() < 1e-14
    for k, name in enumerate(("dx", "dy", "dsx", "dsy", "dr"), 1):
        # Third derivatives are at most 50 here: error of 1e-8, and 1e-16 / 1e-5 of rounding.
        difference = (value(**{name: step}) - value(**{name: -step})) / (2 * step)
        assert np.abs(slopes[k] - difference).max() < 2e-8
        assert np.abs(slopes[k]).max() > 1e-2


@pytest.mark.parametrize("shape", SHAPES)
def test_curvatures_are_those_of_differences(shape):
    x, y, step = np.array([0.3]), np.array([-0.2]), 1e-5

    def slopes(dx=0.0, dy=0.0):
        return gradients(x + dx, y + dy, shape, 7, 9)

    xx, yy, xy = curvatures(slopes(), shape)
    by_x = (slopes(dx=step) - slopes(dx=-step)) / (2 * step)
    by_y = (slopes(dy=step) - slopes(dy=-step)) / (2 * step)
    for found, difference in ((xx, by_x[1]), (yy, by_y[2]), (xy, by_x[2]), (xy, by_y[1])):
        assert np.abs(found - difference).max() < 1e-7
        assert np.abs(found).max() > 1e-2


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (Shape(0.05, 1.0), "sigma_x = 0.05 pixel must be from 0.1"),
        (Shape(1.0, np.nan), "sigma_y = nan"),
        (Shape(1.0, 1.0, 0.9), "correlation = 0.9 must be from -0.8 to 0.8"),
    ],
)
def test_shapes_out_of_range_are_refused(shape, words):
    with pytest.raises(MeasurementError, match=words):
        integrate_gaussian([0.0], [0.0], shape, 9)
