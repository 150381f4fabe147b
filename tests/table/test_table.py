"""Tables: what they may hold, polygons that tile the plane, the outside refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor.response.vertices import vertex_fractions
from bfsensor.table.table import DistortionTable
from tests.table.rough_tables import (
    ARRAYS,
    BACKGROUNDS,
    CHARGES,
    DEPTHS,
    make_table,
    refusal,
    shapes,
    shoelace,
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"charges": CHARGES[::-1]},
            f"charges = {CHARGES[::-1].tolist()} must be finite and ascend",
        ),
        (
            {"depths": np.array([1.0, 1.0, 2.0, 3.0])},
            "depths = [1.0, 1.0, 2.0, 3.0] must be finite and ascend",
        ),
        (
            {"backgrounds": np.array([0.0, np.nan])},
            "backgrounds = [0.0, nan] must be finite and ascend",
        ),
        ({"charges": np.zeros(0)}, "charges = [] must be finite and ascend"),
        ({"charges": CHARGES - 1}, "charges and backgrounds must not be negative"),
        (
            {"depths": DEPTHS - 1},
            "depths = [0.0, 9.0, 39.0, 99.0] must be above the gates, 0 um",
        ),
        (
            {"reach": 1},
            "corners has the shape (5, 4, 4, 6, 6, 2), not (5, 4, 4, 4, 4, 2)",
        ),
        (
            {"vertices": 5},
            "horizontal has the shape (5, 4, 4, 6, 5, 4, 2), not (5, 4, 4, 6, 5, 5, 2)",
        ),
        (
            {"corners": np.full((5, 4, 4, 6, 6, 2), np.inf)},
            "corners holds values that are not finite",
        ),
        (
            {"corners": np.ones((5, 4, 4, 6, 6, 2))},
            "corners holds shifts where the charge equals the background and nothing moves",
        ),
    ],
)
def test_what_is_no_table_is_refused(changes, message):
    assert refusal(dataclasses.replace, make_table(), **changes) == message


# -- questions ---------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(2, 10**6),
    symmetric=st.booleans(),
    charge=st.floats(0, 150e3),
    background=st.floats(0, 60e3),
    depth=st.floats(1, 100),
    reach=st.integers(1, 3),
    vertices=st.integers(1, 5),
)
def test_pixels_tile_the_plane(seed, symmetric, charge, background, depth, reach, vertices):
    """Whatever the shifts, the areas add up to the area inside the outer outline."""
    table = make_table(seed, symmetric=symmetric, reach=reach, vertices=vertices, size=1.0)
    where = {"charge": charge, "background": background, "depth": depth}
    moved, nominal = table.displacements(**where), table.nominal()
    c, h, v = (getattr(nominal, n) + getattr(moved, n) for n in ARRAYS)
    n = 2 * reach + 1
    outline = [c[0, 0][None]]
    for i in range(n):
        outline += [h[0, i], c[0, i + 1][None]]
    for j in range(n):
        outline += [v[j, n], c[j + 1, n][None]]
    for i in reversed(range(n)):
        outline += [h[n, i, ::-1], c[n, i][None]]
    for j in reversed(range(n)):
        outline += [v[j, 0, ::-1], c[j, 0][None]]
    areas = table.areas(**where)
    # Round-off: some 1e3 terms of 1e2 um^2 at 1e-16 each, far below 1e-9 of the sum.
    assert areas.sum() == pytest.approx(shoelace(np.concatenate(outline)), rel=1e-9)
    # One subtraction of 10 um x 12 um.
    np.testing.assert_allclose(table.area_changes(**where), areas - 120.0, atol=1e-13)
    for i, j in ((0, 0), (reach, -reach), (-1, 1)):
        polygon = table.polygon(i, j, **where)
        assert polygon.shape == (4 * vertices + 4, 2)
        assert shoelace(polygon) == pytest.approx(areas[j + reach, i + reach], rel=1e-12)


def test_polygons_start_at_the_middle_of_the_left_side():
    table = make_table(size=0.0, vertices=4)
    polygon = table.polygon(1, -1, charge=0.0, background=40e3, depth=10.0)
    f = vertex_fractions(4)
    # Pixel (1, -1): x from 5 to 15, y from -18 to -6; the first vertex below the middle.
    np.testing.assert_allclose(polygon[0], [5.0, -18 + 12 * f[1]], rtol=1e-15)
    np.testing.assert_allclose(polygon[2], [5.0, -18.0], rtol=1e-15)  # lower left corner
    np.testing.assert_allclose(polygon[3], [5 + 10 * f[0], -18.0], rtol=1e-15)


def test_vertex_fractions_are_equal_angles():
    angle = np.arctan(2 * vertex_fractions(6) - 1)
    np.testing.assert_allclose(np.diff(angle), np.pi / 14, rtol=1e-14)


def test_nodes_are_given_back():
    table = make_table(symmetric=False)
    for q, charge in enumerate(CHARGES):
        for b, background in enumerate(BACKGROUNDS):
            for d, depth in enumerate(DEPTHS):
                moved = table.displacements(
                    charge=charge, background=background, depth=depth
                )
                for name in ARRAYS:
                    # A response is divided and multiplied by Q - B and weighted with
                    # splines of up to 10: 1e-13 of a shift of 0.2 um.
                    np.testing.assert_allclose(
                        getattr(moved, name), getattr(table, name)[q, b, d], atol=2e-14
                    )


@settings(max_examples=40, deadline=None)
@given(charge=st.floats(0, 60e3), depth=st.floats(1, 100))
def test_nothing_moves_where_charge_equals_background(charge, depth):
    table = make_table(symmetric=False)
    moved = table.displacements(charge=charge, background=charge, depth=depth)
    assert all(np.all(getattr(moved, name) == 0) for name in ARRAYS)
    # An electron more moves something: the test above is not one of an empty table.
    more = table.displacements(charge=charge + 1, background=charge, depth=depth)
    assert all(np.any(getattr(more, name) != 0) for name in ARRAYS)


def smooth_table(response, charges, backgrounds, depths):
    """A table whose shifts are (Q - B) response(Q, B, z) times fixed random shifts."""
    rng = np.random.default_rng(606)
    q, b, z = np.meshgrid(charges, backgrounds, depths, indexing="ij")
    size = (q - b) * response(q, b, z)
    pattern = {n: rng.uniform(0.5, 1, s) for n, s in shapes(1, 2).items()}
    arrays = {n: np.multiply.outer(size, p) for n, p in pattern.items()}
    return pattern, DistortionTable(
        charges=charges, backgrounds=backgrounds, depths=depths, pitch=(10.0, 10.0),
        thickness=100.0, vertices=2, reach=1, symmetric=False, **arrays,
    )  # fmt: skip


def worst(response, charges, backgrounds, depths):
    """Largest relative error of a response at points between the levels."""
    pattern, table = smooth_table(response, charges, backgrounds, depths)
    rng = np.random.default_rng(919)
    error = 0.0
    for _ in range(60):
        q, b = rng.uniform(80e3, charges[-1]), rng.uniform(0, backgrounds[-1])
        z = np.exp(rng.uniform(*np.log(depths[[0, -1]])))
        moved = table.displacements(charge=q, background=b, depth=z)
        for name in ARRAYS:
            ratio = getattr(moved, name) / pattern[name] / ((q - b) * response(q, b, z))
            error = max(error, np.abs(ratio - 1).max())
    return error


def test_a_polynomial_response_is_exact():
    def response(q, b, z):
        return (
            1e-6 * (1 - q / 4e5 + (q / 4e5) ** 2) * (1 + (b / 2e5) ** 3) * (2 + np.log(z))
        )

    # Squares in charge, also across Q = B where it comes from three neighbours; cubes in
    # background; linear in log z.  Left is single precision, 6e-8, of shifts that Q - B
    # = 20000 e- of 150000 e- divides: weights of the splines below 10.
    assert worst(response, CHARGES, BACKGROUNDS, DEPTHS) < 6e-7


def test_interpolation_converges_as_cubics_do():
    def response(q, b, z):
        return 1e-6 * np.exp(-q / 1e5) * (1 + 0.3 * np.sin(b / 3e4)) * (2 + np.log(z))

    errors = [
        worst(
            response,
            np.linspace(0, 15e4, 4 * k + 1),
            np.linspace(0, 6e4, 3 * k + 1),
            DEPTHS,
        )
        for k in (1, 2, 4)
    ]
    # A cubic spline has order 4 (the Q = B nodes 3): halving the step divides the error by
    # 16 or 8, asymptotically; 5 leaves room for the coarsest.  The first spline is within
    # h^4 max|f''''| of either factor: (37500 / 1e5)^4 = 2 % and (2e4 / 3e4)^4 x 0.3 = 6 %.
    assert errors[0] < 0.08
    assert errors[1] < errors[0] / 5
    assert errors[2] < errors[1] / 5


def test_depths_never_overshoot():
    """Monotone in depth at the levels, monotone between (a cubic spline would ring)."""
    depths = np.array([1.0, 5.0, 6.0, 50.0, 100.0])
    steps = np.array([0.0, 0.01, 1.0, 1.0, 1.01])
    pattern, table = smooth_table(
        lambda q, b, z: 1e-6 * np.interp(z, depths, steps), CHARGES, BACKGROUNDS, depths
    )
    at = np.geomspace(1, 100, 200)
    shifts = [table.displacements(charge=9e4, depth=z).corners[0, 0, 0] for z in at]
    # Up to single precision, 6e-8 of 0.1 um.
    assert np.diff(shifts).min() > -1e-8
    assert max(shifts) == pytest.approx(0.0909 * pattern["corners"][0, 0, 0], rel=1e-6)


def test_one_charge_scales_linearly():
    table = make_table(charges=np.array([80e3]), backgrounds=np.zeros(1))
    full = table.displacements(charge=80e3, depth=33.0).horizontal
    half = table.displacements(charge=40e3, depth=33.0).horizontal
    assert np.abs(full).max() > 0
    np.testing.assert_allclose(half, full / 2, rtol=1e-14)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        (
            {"charge": 150_001.0, "depth": 10.0},
            "charge = 150001 is outside the table, which holds from 0 to 150000 e- "
            "(full well 174,017 e-)",
        ),
        (
            {"charge": -1.0, "depth": 10.0},
            "charge = -1 is outside the table, which holds from 0 to 150000 e- "
            "(full well 174,017 e-)",
        ),
        (
            {"charge": float("nan"), "depth": 10.0},
            "charge = nan is outside the table, which holds from 0 to 150000 e- "
            "(full well 174,017 e-)",
        ),
        (
            {"charge": 1e4, "background": 60_001.0, "depth": 10.0},
            "background = 60001 is outside the table, which holds from 0 to 60000 e-",
        ),
        (
            {"charge": 1e4, "depth": 0.9},
            "depth = 0.9 is outside the table, which holds from 1 to 100 um",
        ),
        (
            {"charge": 1e4, "depth": 100.1},
            "depth = 100.1 is outside the table, which holds from 1 to 100 um",
        ),
    ],
)
@pytest.mark.parametrize("question", ["displacements", "areas", "area_changes"])
def test_questions_outside_are_refused(question, where, message):
    table = make_table(full_well=174_017.0)
    assert refusal(getattr(table, question), **where) == message


def test_refusals_of_small_tables_and_far_pixels():
    table = make_table(charges=CHARGES[2:3], backgrounds=np.zeros(1), depths=DEPTHS[1:2])
    assert refusal(table.areas, charge=1.0, depth=11.0) == (
        "depth = 11 is outside the table, which holds 10 um"
    )
    assert refusal(table.areas, charge=1.0, background=2.0, depth=10.0) == (
        "background = 2 is outside the table, which holds 0 e-"
    )
    assert refusal(table.polygon, 0, -3, charge=1.0, depth=10.0) == (
        "offset (0, -3) is outside the table, which reaches 2 pixels"
    )
