"""Distortion tables: interpolation, polygons that tile, what a table may hold."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor.errors import TableError
from bfsensor.response.vertices import vertex_fractions
from tests.table.smooth_tables import (
    BACKGROUNDS,
    CHARGES,
    DEPTHS,
    SINGLE,
    make_rough_table,
    make_table,
    parts,
    polygon_area,
    pull,
    unit_response,
)


@pytest.fixture(scope="module")
def table():
    return make_table(full_well=170_000.0)


# -- interpolation ---------------------------------------------------------------------


@pytest.mark.parametrize("vertices", [1, 2, 7, 32])
def test_vertices_stand_at_equal_angles_seen_from_the_pixel_centre(vertices):
    angles = np.arctan(2 * vertex_fractions(vertices) - 1)
    steps = np.diff([-np.pi / 4, *angles, np.pi / 4])
    assert np.allclose(steps, np.pi / 2 / (vertices + 1), rtol=1e-12)


@given(
    background=st.floats(BACKGROUNDS[0], BACKGROUNDS[-1]),
    depth=st.floats(DEPTHS[0], DEPTHS[-1]),
)
@settings(max_examples=40, deadline=None)
def test_a_uniform_image_does_not_distort(table, background, depth):
    shifts = table.displacements(charge=background, background=background, depth=depth)
    assert all(np.all(part == 0) for part in parts(shifts))
    nearby = table.displacements(
        charge=background + 100, background=background, depth=depth
    )
    assert np.abs(nearby.corners).max() > 0


def test_levels_come_back(table):
    for q, charge in enumerate(CHARGES):
        for b, background in enumerate(BACKGROUNDS):
            for d, depth in enumerate(DEPTHS):
                shifts = table.displacements(
                    charge=charge, background=background, depth=depth
                )
                for name in ("corners", "horizontal", "vertical"):
                    kept = getattr(table, name)[q, b, d]
                    # A division and a multiplication: a few times the double round-off.
                    assert np.allclose(getattr(shifts, name), kept, rtol=1e-13, atol=1e-15)


@given(
    charge=st.floats(CHARGES[0], CHARGES[-1]),
    background=st.floats(BACKGROUNDS[0], BACKGROUNDS[-1]),
    depth=st.floats(DEPTHS[0], DEPTHS[-1]),
)
@settings(max_examples=60, deadline=None)
def test_responses_cubic_in_both_charges_are_interpolated_exactly(
    charge, background, depth
):
    # No level has Q = B, so nothing is filled in; four levels carry a cubic.
    table = make_table(backgrounds=[1e3, 23e3, 61e3, 1e5], charges=CHARGES)
    background = max(background, 1e3)
    shifts = table.displacements(charge=charge, background=background, depth=depth)
    exact = (charge - background) / 1e5 * unit_response(charge, background, depth)
    expected = exact * pull(np.array(5.0), np.array(5.0))
    # Single precision of a level, |D| / |Q - B| at most at the closest Q and B (1000 e-
    # apart), times |Q - B| < 1.5e5 e-, times the weights of the splines (below 3 each).
    size = np.abs(pull(np.array(5.0), np.array(5.0))).max()
    assert np.abs(shifts.corners[3, 3] - expected).max() < 9 * 2 * SINGLE * size * 1.5


def test_smooth_responses_converge_with_the_levels():
    def bent(charge, background, depth):
        return np.exp(-charge / 6e4 + background / 2e5) * (1 + 0 * depth)

    errors = []
    for count in (5, 9, 17):
        levels = np.linspace(0.0, 150_000.0, count)
        table = make_table(levels, [0.0], [95.0], response=bent)
        asked = np.linspace(2_000.0, 149_000.0, 40)
        found = [table.displacements(charge=q, depth=95.0).corners[3, 3, 1] for q in asked]
        exact = asked / 1e5 * bent(asked, 0.0, 95.0) * pull(np.array(5.0), np.array(5.0))[1]
        errors.append(np.abs(np.array(found) - exact).max() / np.abs(exact).max())
    # The level Q = B is filled by a parabola, the rest by cubics: third order, 8 a halving.
    # A fifth less is left for levels that are not yet asymptotic.
    assert errors[0] / errors[1] > 6.4
    assert errors[1] / errors[2] > 6.4
    # Third order: h^3 / (6 scale^3) times (2/3)^(3/2) / 6 at most, with h / scale = 0.16.
    assert errors[2] < 5e-4


@given(depths=st.tuples(st.floats(2.0, 100.0), st.floats(2.0, 100.0)))
@settings(max_examples=40, deadline=None)
def test_shifts_rise_with_depth_without_overshoot(depths):
    table = make_table(
        [5e4], [0.0], DEPTHS, response=lambda q, b, z: np.minimum(z / 20.0, 1.0) + 0 * q
    )
    low, high = sorted(depths)
    shallow, deep = (
        np.abs(table.displacements(charge=5e4, depth=z).corners).max() for z in (low, high)
    )
    top = np.abs(table.corners).max()
    assert shallow <= deep * (1 + 1e-12)
    assert deep <= top * (1 + 1e-12)


@pytest.mark.parametrize("charge", [0.0, 1.0, 37_000.0, 100_000.0])
def test_a_table_of_one_charge_is_linear_in_charge(charge):
    table = make_table([1e5], [0.0], [95.0])
    shifts = table.displacements(charge=charge, depth=95.0)
    assert np.allclose(
        shifts.vertical, table.vertical[0, 0, 0] * charge / 1e5, rtol=1e-12, atol=1e-15
    )


def test_one_background_and_one_depth_answer_only_there():
    table = make_table(CHARGES, [20_000.0], [50.0])
    assert table.area_changes(charge=5e4, background=2e4, depth=50.0)[2, 2] < 0
    with pytest.raises(TableError, match=r"background = 0 is outside .* holds 20000 e-"):
        table.displacements(charge=5e4, depth=50.0)
    with pytest.raises(TableError, match=r"depth = 51 is outside .* holds 50 um"):
        table.displacements(charge=5e4, background=2e4, depth=51.0)


@pytest.mark.parametrize(
    ("question", "message"),
    [
        (
            {"charge": 2e5, "depth": 9.0},
            r"charge = 200000 .*0 to 150000.*full well 170,000 e-",
        ),
        ({"charge": -1.0, "depth": 9.0}, r"charge = -1 is outside"),
        ({"charge": np.nan, "depth": 9.0}, r"charge = nan is outside"),
        (
            {"charge": 1e4, "background": 1.1e5, "depth": 9.0},
            r"background = 110000 .*0 to 100000",
        ),
        ({"charge": 1e4, "depth": 1.9}, r"depth = 1.9 .*from 2 to 100 um"),
        ({"charge": 1e4, "depth": 100.1}, r"depth = 100.1 is outside"),
    ],
)
def test_questions_outside_the_table_are_refused(table, question, message):
    for method in (table.displacements, table.areas, table.area_changes):
        with pytest.raises(TableError, match=message):
            method(**question)


# -- polygons and areas ----------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), vertices=st.integers(1, 6), reach=st.integers(0, 3))
@settings(max_examples=40, deadline=None)
def test_polygons_tile_the_plane(seed, vertices, reach):
    table = make_rough_table(seed, reach=reach, vertices=vertices)
    where = {"charge": 51_000.0, "background": 7_000.0, "depth": 33.0}
    areas = table.areas(**where)
    shifts, nominal = table.displacements(**where), table.nominal()
    c, h, v = (a + b for a, b in zip(parts(shifts), parts(nominal), strict=True))
    n = 2 * reach + 1
    outline = []
    for i in range(n):
        outline += [c[0, i], *h[0, i]]
    for j in range(n):
        outline += [c[j, n], *v[j, n]]
    for i in reversed(range(n)):
        outline += [c[n, i + 1], *h[n, i, ::-1]]
    for j in reversed(range(n)):
        outline += [c[j + 1, 0], *v[j, 0, ::-1]]
    assert areas.sum() == pytest.approx(polygon_area(np.array(outline)), rel=1e-9)
    assert areas.shape == (n, n)


def test_areas_are_those_of_the_polygons_and_neighbours_gain(table):
    where = {"charge": 1e5, "depth": 40.0}
    areas = table.areas(**where)
    for i, j in ((0, 0), (1, 0), (0, 1), (-2, 1)):
        polygon = table.polygon(i, j, **where)
        assert polygon.shape == (4 * table.vertices + 4, 2)
        # Counter-clockwise: the signed area is positive.
        assert polygon_area(polygon) == pytest.approx(areas[j + 2, i + 2], rel=1e-12)
    changes = table.area_changes(**where)
    assert np.allclose(changes, areas - 100.0)
    assert changes[2, 2] < 0 < changes[2, 3] < changes[3, 2]


def test_areas_of_a_uniform_stretch_are_exact():
    # x -> (1 + a) x, y -> (1 + b) y multiplies every area by (1 + a)(1 + b).
    table = make_table(
        [1e5], [0.0], [95.0], response=lambda q, b, z: 1.0 + 0 * q,
        field=lambda x, y: np.stack(np.broadcast_arrays(0.02 * x, -0.01 * y), -1),
    )  # fmt: skip
    areas = table.areas(charge=1e5, depth=95.0)
    assert np.allclose(areas, 100 * 1.02 * 0.99, rtol=40 * SINGLE)


@pytest.mark.parametrize("vertices", [2, 4, 8, 32])
def test_polygons_start_on_the_left_just_below_the_centre(vertices):
    table = make_table([1e5], [0.0], [95.0], vertices=vertices)
    first, last = table.polygon(0, 0, charge=0.0, depth=95.0)[[0, -1]]
    assert first[0] == last[0] == -5.0
    assert first[1] < 0 < last[1]
    assert first[1] == pytest.approx(-last[1], rel=1e-12)


def test_polygons_are_refused_beyond_the_reach(table):
    with pytest.raises(TableError, match=r"offset \(3, 0\) .* reaches 2 pixels"):
        table.polygon(3, 0, charge=1e4, depth=9.0)


# -- construction ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"charges": CHARGES[::-1]}, "charges = .* must be finite and ascend"),
        ({"depths": np.array([2.0, 6.0, 20.0, np.nan, 100.0])}, "depths = .* finite"),
        ({"backgrounds": BACKGROUNDS - 1.0}, "must not be negative"),
        (
            {"charges": CHARGES[:-1]},
            r"corners has the shape \(5, 4, 5, 6, 6, 2\), not \(4,",
        ),
        ({"depths": DEPTHS - 2.0}, "depths = .* must be above the gates"),
        ({"depths": DEPTHS + 1.0}, "not be above the thickness, 100 um"),
        ({"pitch": (10.0, 0.0)}, "pitch y = 0.0 um must be finite and above 0"),
        ({"thickness": np.inf}, "thickness = inf um"),
        ({"full_well": 0.0}, "full_well = 0.0 e-"),
        ({"vertices": 0}, "vertices = 0 must be a whole number from 1"),
        ({"reach": 1.5}, "reach = 1.5 must be a whole number"),
    ],
)
def test_wrong_tables_are_refused(table, change, message):
    with pytest.raises(TableError, match=message):
        replace(table, **change)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_values_that_are_not_finite_are_refused(table, value):
    vertical = table.vertical.copy()
    vertical[1, 1, 1, 0, 0, 0, 0] = value
    with pytest.raises(TableError, match="vertical holds values that are not finite"):
        replace(table, vertical=vertical)


def test_one_charge_equal_to_a_background_says_nothing():
    with pytest.raises(TableError, match="one that differs from the background, 20000 e-"):
        make_table([20_000.0], BACKGROUNDS, DEPTHS)


def test_tables_are_constant_and_pickle(table):
    for name in ("charges", "backgrounds", "depths", "corners", "horizontal", "vertical"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(table, name)[0] = 1.0
    with pytest.raises(TypeError):
        table.errors["mesh [%]"] = 1.0
    assert pickle.loads(pickle.dumps(table)) == table


@pytest.mark.parametrize(
    "change",
    [
        {"full_well": 1.0}, {"full_well": np.nan}, {"errors": {"mesh [%]": 1.0}},
        {"errors": {"mesh [%]": np.nan}}, {"provenance": {"cells": "16"}},
        {"device_text": "x"}, {"symmetric": False}, {"thickness": 101.0},
        {"depths": np.array([2.0, 6.0, 20.0, 50.0, 99.9])},
    ],
)  # fmt: skip
def test_tables_differ_when_anything_does(table, change):
    changed = replace(table, **change)
    assert changed != table
    assert changed == replace(table, **change)
    corners = table.corners.copy()
    corners[1, 0, 0, 0, 0, 0] = np.nextafter(
        np.float32(corners[1, 0, 0, 0, 0, 0]), np.float32(1)
    )
    assert replace(table, corners=corners) != table
