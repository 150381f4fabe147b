"""Rectangles in closed form against point charges spread over them."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor._kernels import image_charge as kernel

pytestmark = pytest.mark.kernels

HALF_X, HALF_Y = 1.7, 2.6
# Beside the rectangle, over it, under it, over a side, far away; heights above it.
PLACES = [
    (5.0, 1.0, 0.8), (-5.0, -4.0, 0.8), (0.3, 0.4, 1.5), (0.3, -0.4, -1.5), (1.7, 2.0, 2.0),
    (45.0, 25.0, 7.0), (2.0, 6.0, 0.0), (-6.0, 0.5, 0.0), (5.0, 5.0, -90.0),
]  # fmt: skip


def spread(x, y, h, n=120):
    """Field (ex, ey, ez) of n x n point charges at Gauss points of the rectangle."""
    node, weight = np.polynomial.legendre.leggauss(n)
    u, v = x - HALF_X * node[:, None], y - HALF_Y * node[None]
    share = 0.25 * np.outer(weight, weight) / (u**2 + v**2 + h**2) ** 1.5
    return np.array([(share * u).sum(), (share * v).sum(), (share * h).sum()])


@pytest.mark.parametrize("place", PLACES)
def test_closed_form_is_the_sum_of_point_charges(place):
    x, y, h = place
    area = 4 * HALF_X * HALF_Y
    found = [
        kernel.across(x, y, h, HALF_X, HALF_Y) / area,
        kernel.across(y, x, h, HALF_Y, HALF_X) / area,
        kernel.upward(x, y, h, HALF_X, HALF_Y) / area,
    ]
    # 120 Gauss points over 5.2 um, 0.8 um and more from the nearest charge: far below 1e-9;
    # four logarithms or angles of order one leave 1e-15 of 1/area.
    np.testing.assert_allclose(found, spread(x, y, h), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("u", [-5.0, 1.7, 5.0, 45.0])
@pytest.mark.parametrize("ends", [(-5.0, 5.0), (5.0, 15.0), (-15.0, -5.0), (-1.0, 4.0)])
def test_edges_are_the_integral_of_points(u, ends):
    node, weight = np.polynomial.legendre.leggauss(80)
    v = 0.5 * (ends[0] + ends[1]) + 0.5 * (ends[1] - ends[0]) * node
    points = [kernel.across(u, each, 1.3, HALF_X, HALF_Y) for each in v]
    wanted = 0.5 * (ends[1] - ends[0]) * np.dot(weight, points)
    found = kernel.across_edge(u, *ends, 1.3, HALF_X, HALF_Y)
    # Round-off of v asinh(v / rho), up to 40 um.
    assert found == pytest.approx(wanted, rel=1e-9, abs=1e-13)


def test_shifts_follow_from_fields():
    """Both integrators add up what add_fields gives, images and tail, by interval."""
    heights, signs = np.array([1.0, -1.0, 21.0]), np.array([1.0, -1.0, 1.0])
    half, tail = np.array([HALF_X, HALF_Y]), np.array([1e-3, 2e-5])
    nodes, weights = np.array([2.0, 3.0, 5.0]), np.array([0.7, 1.1, 0.4])
    interval = np.array([0, 0, 1])
    points = np.array([[5.0, 1.0], [-5.0, 2.0], [15.0, -4.0]])
    sums = np.zeros((2, 3))
    kernel.add_point_shifts(
        points, nodes, weights, interval, heights, signs, half, tail, sums
    )
    wanted = np.zeros((2, 3))
    for z, w, row in zip(nodes, weights, interval, strict=True):
        field = np.zeros((3, 3))
        at = np.column_stack([points, np.full(3, z)])
        kernel.add_fields(at, heights, signs, half, tail, field)
        wanted[row] += w * field[:, 0]
    np.testing.assert_allclose(sums, wanted, rtol=1e-12)
    # A short edge is a point.
    edges = np.column_stack([points[:, 0], points[:, 1] - 1e-3, points[:, 1] + 1e-3])
    means = np.zeros((2, 3))
    kernel.add_edge_shifts(
        edges, nodes, weights, interval, heights, signs, half, tail, means
    )
    np.testing.assert_allclose(means, wanted, rtol=1e-6)


def test_the_tail_is_a_harmonic_potential():
    """Without images the field is that of tail[0] z + tail[1] (z^3 - 1.5 z rho^2)."""
    tail, half = np.array([0.3, 0.02]), np.array([1e-6, 1e-6])

    def potential(p):
        return tail[0] * p[2] + tail[1] * (p[2] ** 3 - 1.5 * p[2] * (p[0] ** 2 + p[1] ** 2))

    at, step = np.array([2.0, -3.0, 4.0]), 1e-4
    field = np.zeros((1, 3))
    kernel.add_fields(at[None], np.zeros(0), np.zeros(0), half, tail, field)
    for k in range(3):
        e = step * np.eye(3)[k]
        slope = (potential(at + e) - potential(at - e)) / (2 * step)
        assert field[0, k] == pytest.approx(-slope, abs=1e-7)
