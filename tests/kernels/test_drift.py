"""Field lines in potentials whose field lines are known."""

import numpy as np
import pytest

from bfsensor._kernels import drift

pytestmark = pytest.mark.kernels


def grid(function, x, y, z):
    return np.ascontiguousarray(
        function(x[None, None, :], y[:, None, None], z[None, :, None])
    )


NODES = np.array([-3.0, -2.2, -1.5, -0.9, -0.2, 0.4, 1.1, 1.7, 2.6, 3.0, 3.9])


def gradient_at(phi, p):
    out = np.zeros(3)
    drift.gradient(
        phi, NODES, NODES, NODES, *p, np.ones(3, np.int64), np.zeros((6, 4)), out
    )
    return out


def test_gradient_is_exact_for_quadratic_potentials():
    # Hermite cubics with parabolic slopes reproduce parabolas.
    phi = grid(lambda x, y, z: x**2 - 0.5 * y * z + 3 * z**2 - x + y, NODES, NODES, NODES)
    for p in ((0.3, -1.0, 0.9), (1.69, 0.0, 2.0), (-1.5, 1.7, -2.0)):
        x, y, z = p
        expected = [2 * x - 1, -0.5 * z + 1, -0.5 * y + 6 * z]
        assert np.allclose(gradient_at(phi, p), expected, atol=1e-10)


def test_gradient_error_falls_with_the_square_of_the_mesh_or_faster():
    def function(x, y, z):
        return np.sin(x) * np.cos(0.7 * y) * np.exp(0.3 * z)

    points = np.random.default_rng(409).uniform(-1.5, 1.5, (200, 3))
    x, y, z = points.T
    exact = np.stack(
        [
            np.cos(x) * np.cos(0.7 * y) * np.exp(0.3 * z),
            -0.7 * np.sin(x) * np.sin(0.7 * y) * np.exp(0.3 * z),
            0.3 * function(x, y, z),
        ],
        axis=1,
    )
    errors = []
    for n in (12, 24, 48):
        nodes = np.linspace(-3, 3, n)
        phi = grid(function, nodes, nodes, nodes)
        found = np.zeros_like(points)
        for row, p in zip(found, points, strict=True):
            drift.gradient(
                phi, nodes, nodes, nodes, *p, np.ones(3, np.int64), np.zeros((6, 4)), row
            )
        errors.append(np.sqrt(np.mean((found - exact) ** 2)))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates.min() > 1.9, (errors, rates)
    assert errors[-1] < 2e-3


def test_trace_up_follows_the_analytic_field_line():
    # phi = x^2 / 2 + y^2 / 2 - z^2: dx/dz = x / (-2 z), so x = x0 sqrt(z0 / z), and y alike.
    nodes = np.linspace(-2.0, 12.0, 57)
    phi = grid(lambda x, y, z: 0.5 * (x**2 + y**2) - z**2, nodes, nodes, nodes)
    seeds = np.array([[1.0, 0.3, 1.0], [0.5, 0.0, 2.0]])
    depths = np.array([4.0, 9.0])
    out = np.zeros((2, 2, 2))
    drift.trace_up(phi, nodes, nodes, nodes, seeds, depths, 0.1, out)
    falling = np.sqrt(seeds[:, 2:] / depths[None, :])
    # RK4 with 10 % steps: local error 1e-5/120, about 25 steps.
    for axis in (0, 1):
        at_seed = seeds[:, axis, None]
        assert np.allclose(out[:, :, axis], at_seed * falling, atol=3e-6)


def test_bisection_finds_the_watershed_of_two_wells():
    # Two wells at x = -5 and 5 (period 10 as pixels at 0 and 10); the watershed is x = 5 + s.
    shift = 0.173
    nodes = np.linspace(-3.0, 13.0, 65)
    z = np.linspace(-1.0, 9.0, 41)
    x = nodes[None, None, :]
    phi = (
        -np.cos(2 * np.pi * (x - shift - 5.0) / 10.0)
        - 0.3 * z[None, :, None]
        - 0.05 * nodes[:, None, None] ** 2
    )
    phi = np.ascontiguousarray(phi)
    zone = np.array([10.0, 10.0, 4.0, 9.0, 1.0])
    seeds = np.array([[5.0, 0.0, 6.0], [5.0, 0.5, 6.0]])
    out = np.zeros(2)
    failed = drift.bisect_edge(
        phi,
        nodes,
        nodes,
        z,
        seeds,
        0,
        np.full(2, 5.0),
        np.full(2, -0.01),
        np.full(2, 0.01),
        1e-6,
        zone,
        0.25,
        4000,
        out,
    )
    assert failed == 0
    # A Hermite cubic moves an extremum by h^3 k^2 / 24 at most (k = 0.63/um, h = 0.25 um).
    assert np.allclose(out, 5.0 + shift, atol=3.0e-4)


def test_bisection_reports_seeds_without_a_watershed():
    nodes = np.linspace(-3.0, 13.0, 33)
    phi = grid(lambda x, y, z: 1.0 * x - 0.1 * z + 0 * y, nodes, nodes, nodes)
    zone = np.array([10.0, 10.0, 4.0, 9.0, 1.0])
    out = np.zeros(1)
    failed = drift.bisect_edge(
        phi, nodes, nodes, nodes, np.array([[5.0, 0.0, 3.0]]), 0, np.full(1, 5.0),
        np.full(1, -1e-4), np.full(1, 1e-4), 1e-6, zone, 0.5, 200, out,
    )  # fmt: skip
    assert failed == 1
    assert np.isnan(out[0])


def test_a_field_without_a_watershed_is_given_up_after_some_seeds():
    nodes = np.linspace(-3.0, 13.0, 33)
    phi = grid(lambda x, y, z: 1.0 * x - 0.1 * z + 0 * y, nodes, nodes, nodes)
    zone = np.array([10.0, 10.0, 4.0, 9.0, 1.0])
    number = drift.MOST_FAILED + 3
    seeds = np.repeat([[5.0, 0.0, 3.0]], number, axis=0)
    out = np.zeros(number)
    failed = drift.bisect_edge(
        phi, nodes, nodes, nodes, seeds, 0, np.full(number, 5.0), np.full(number, -1e-4),
        np.full(number, 1e-4), 1e-6, zone, 0.5, 200, out,
    )  # fmt: skip
    assert failed == drift.MOST_FAILED
    assert np.isnan(out).all()


def test_paths_that_are_left_early_end_where_they_were_going():
    """Winding boundary: what leaves the edge on one side may yet end on the other."""
    nodes, z = np.linspace(-3.0, 13.0, 65), np.linspace(-1.0, 9.0, 41)
    x, height = nodes[None, None, :], z[None, :, None]
    bent = 5.0 + 0.8 * np.sin(1.5 * height)
    phi = (
        -np.cos(2 * np.pi * (x - bent) / 10.0)
        - 0.3 * height
        - 0.05 * nodes[:, None, None] ** 2
    )
    phi = np.ascontiguousarray(phi)
    zone = np.array([10.0, 10.0, 4.0, 9.0, 1.0])
    seeds = np.array([[5.0, 0.0, 6.0], [5.0, 0.5, 6.0], [5.0, 1.0, 5.0]])

    def bisected(leave):
        out = np.zeros(3)
        assert not drift.bisect_edge(
            phi, nodes, nodes, z, seeds, 0, np.full(3, 5.0), np.full(3, -0.01),
            np.full(3, 0.01), 1e-6, zone, 0.25, 4000, out, drift.ANY_TURN, leave,
        )  # fmt: skip
        return out

    whole = bisected(np.inf)
    assert np.all(np.abs(whole - 5.0) > 0.3)
    for leave in (0.1, 0.5, 2.0):
        assert np.allclose(bisected(leave), whole, rtol=0, atol=1e-6)
