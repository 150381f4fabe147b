"""Points along boundary lines: polynomials come through unchanged, mirror images agree."""

import numpy as np
import pytest

from bfsensor.simulate.line_points import SMOOTH_POINTS, line_points


def lines(at, pitch):
    """A line between columns: polynomials of order 11 in each pixel, x even and y odd along it."""
    pixel = np.floor(at / pitch + 0.5)
    t = (at - pixel * pitch) / (pitch / 2)
    side = np.where(pixel == 0, 1.0, np.sign(pixel))
    x = 0.3 + np.abs(pixel) + np.where(pixel == 0, t**10, (side * t) ** 11)
    y = at + np.where(pixel == 0, t**11, side * (side * t) ** 8)
    return np.stack([x, y], axis=-1)


@pytest.mark.parametrize("symmetric", [False, True])
def test_polynomials_come_through_unchanged(symmetric):
    points = line_points(2, 10.0, 24, symmetric=symmetric, smooth=True)
    given = line_points(2, 10.0, 24, symmetric=symmetric, smooth=False)
    assert len(points.traced) < 0.6 * len(given.traced)
    found = points.spread(lines(points.traced, 10.0)[None, None], 1)
    inside = np.abs(given.traced) < 25.0
    assert np.allclose(
        found[0, 0, inside], lines(given.traced[inside], 10.0), rtol=0, atol=1e-12
    )
    assert np.allclose(found[0, 0, ~inside], lines(given.traced[~inside], 10.0))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_quadrant_is_half_of_the_whole(smooth):
    whole = line_points(1, 8.0, 18, symmetric=False, smooth=smooth)
    half = line_points(1, 8.0, 18, symmetric=True, smooth=smooth)
    values = lines(whole.traced, 8.0)
    found = half.spread(values[whole.traced >= 0], 1)
    expected = whole.spread(values, 1)
    assert np.allclose(found, expected[len(expected) - len(found) :], rtol=0, atol=1e-13)


def test_few_samples_are_all_traced():
    points = line_points(1, 8.0, SMOOTH_POINTS - 3, symmetric=True, smooth=True)
    assert points.even is None
    assert len(points.traced) == 14 + 2  # the point in the middle of pixel (0, 0) lies at 0
    assert points.traced[0] == 0.0
