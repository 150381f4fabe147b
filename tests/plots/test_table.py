"""Figures of tables: they print and draw what the table holds, and labels carry units."""

from __future__ import annotations

import builtins
import dataclasses

import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.errors import BFSensorError, TableError
from bfsensor.plots import table as show
from bfsensor.response.vertices import vertex_fractions
from bfsensor.table.table import DistortionTable

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

PITCH = 10.0
REACH = 2
VERTICES = 4
CHARGES = np.array([0.0, 30_000.0, 80_000.0])
BACKGROUNDS = np.array([0.0, 30_000.0])
DEPTHS = np.array([3.0, 20.0, 100.0])


def displacement(x, y):
    """Towards the origin, larger across rows than across columns [um at 10^5 e-]."""
    softened = 1.0 + (x**2 + y**2) / 40.0
    return np.stack([-0.08 * x / softened, -0.12 * y / softened], axis=-1)


@pytest.fixture(scope="module")
def table():
    """A table whose displacements are a known smooth field times charge and depth."""
    n = 2 * REACH + 1
    edges = (np.arange(n + 1) - REACH - 0.5) * PITCH
    inner = (edges[:-1, None] + vertex_fractions(VERTICES) * PITCH).reshape(n, VERTICES)
    corners = displacement(edges[None, :], edges[:, None])
    horizontal = displacement(inner[None], edges[:, None, None])
    vertical = displacement(edges[None, :, None], inner[:, None, :])
    weight = (
        (CHARGES[:, None, None] - BACKGROUNDS[None, :, None])
        / 1e5
        * np.tanh(DEPTHS / 9.0)[None, None, :]
    )

    def spread(field):
        return weight[(...,) + (None,) * field.ndim] * field

    return DistortionTable(
        charges=CHARGES,
        backgrounds=BACKGROUNDS,
        depths=DEPTHS,
        pitch=(PITCH, PITCH),
        thickness=100.0,
        vertices=VERTICES,
        reach=REACH,
        corners=spread(corners),
        horizontal=spread(horizontal),
        vertical=spread(vertical),
        errors={},
        device_text=Device.load("itl_sta3800c").to_toml(),
        provenance={},
        full_well=150_000.0,
        symmetric=True,
    )


@pytest.fixture
def ax():
    return new_figure().subplots()


def new_figure():
    from matplotlib.figure import Figure

    return Figure(figsize=(8, 8))


def polygons_of(ax):
    from matplotlib.collections import PolyCollection

    found = [c for c in ax.collections if isinstance(c, PolyCollection)]
    assert len(found) == 1
    return [path.vertices[:-1] for path in found[0].get_paths()]


def shoelace(points):
    x, y = np.asarray(points).T
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


def has_units(ax):
    return "[" in ax.get_xlabel() and "[" in ax.get_ylabel()


def test_boundaries_print_and_draw_the_areas_of_the_table(table, ax):
    show.draw_pixel_boundaries(table, ax, charge=80_000, depth=100.0, reach=1)
    areas = table.areas(charge=80_000, depth=100.0)
    assert len(ax.texts) == 9
    for text in ax.texts:
        i, j = (round(v / PITCH) for v in text.get_position())
        # Printed to two decimals.
        assert float(text.get_text()) == pytest.approx(
            areas[REACH + j, REACH + i], abs=0.00501
        )
    polygons = polygons_of(ax)
    assert len(polygons) == 9
    drawn = np.reshape([shoelace(p) for p in polygons], (3, 3))
    middle = slice(REACH - 1, REACH + 2)
    # Round-off only: polygons and areas are of the same vertices.
    np.testing.assert_allclose(np.abs(drawn), areas[middle, middle], rtol=1e-9)
    assert drawn.ravel()[4] != pytest.approx(PITCH**2, abs=0.5)


def test_boundaries_say_what_they_show(table, ax):
    show.draw_pixel_boundaries(table, ax, charge=80_000, background=30_000, depth=20.0)
    title = ax.get_title().replace("\u2009", "")
    assert "80000 e" in title and "30000 e" in title and "20 µm" in title
    assert "×" not in title
    assert has_units(ax)
    assert "serial" in ax.get_xlabel() and "parallel" in ax.get_ylabel()
    assert len(polygons_of(ax)) == 25


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_exaggeration_scales_displacements_not_areas(table, background):
    axes = new_figure().subplots(1, 2)
    plain, exaggerated = axes
    for ax, factor in ((plain, 1.0), (exaggerated, 7.0)):
        show.draw_pixel_boundaries(
            table, ax, charge=80_000, background=background, depth=100.0, exaggerate=factor
        )
    assert "× 7" in exaggerated.get_title()
    assert [t.get_text() for t in plain.texts] == [t.get_text() for t in exaggerated.texts]
    undistorted = table.polygon(0, 0, charge=0.0, background=0.0, depth=100.0)
    assert np.abs(np.abs(undistorted).max(axis=1) - PITCH / 2).max() < 1e-12
    moved = [polygons_of(a)[12] - undistorted for a in axes]
    np.testing.assert_allclose(moved[1], 7.0 * moved[0], atol=1e-12)
    assert np.abs(moved[0]).max() > 0.05


def test_boundaries_of_a_table_without_a_level_of_no_charge(table, ax):
    """An imported table: one charge, one background, one depth, not symmetric."""
    level, n = (slice(2, 3), slice(0, 1), slice(2, 3)), 2 * REACH + 1
    skewed = np.random.default_rng(5108).normal(0.0, 0.02, (1, 1, 1, n, n + 1, VERTICES, 2))
    single = dataclasses.replace(
        table, charges=CHARGES[2:], backgrounds=BACKGROUNDS[:1], depths=DEPTHS[2:],
        corners=table.corners[level], horizontal=table.horizontal[level],
        vertical=table.vertical[level] + skewed, symmetric=False,
    )  # fmt: skip
    show.draw_pixel_boundaries(single, ax, charge=80_000, depth=100.0, exaggerate=3.0)
    polygons = polygons_of(ax)
    for index, (i, j) in enumerate(np.ndindex(n, n)):
        row, column = i - REACH, j - REACH
        at = {"charge": 80_000, "depth": 100.0}
        moved = single.polygon(column, row, **at) - single.polygon(
            column, row, charge=0.0, depth=100.0
        )
        nominal = single.polygon(column, row, charge=0.0, depth=100.0)
        np.testing.assert_allclose(polygons[index], nominal + 3.0 * moved, atol=1e-12)
    show.figure_for_table(single).canvas.draw()


@pytest.mark.parametrize("size", [(3.5, 3.0), (8.0, 8.0)])
@pytest.mark.parametrize("levels", [1, 3])
def test_legend_of_the_response_lies_above_the_data(table, size, levels):
    from matplotlib.figure import Figure

    level = (slice(3 - levels, 3), slice(0, 1), slice(2, 3))
    few = dataclasses.replace(
        table, charges=CHARGES[3 - levels :], backgrounds=BACKGROUNDS[:1], depths=DEPTHS[2:],
        corners=table.corners[level], horizontal=table.horizontal[level],
        vertical=table.vertical[level],
    )  # fmt: skip
    figure = Figure(figsize=size, layout="constrained")
    ax = figure.subplots()
    show.draw_response(few, ax, depth=100.0)
    figure.canvas.draw()
    highest = max(
        ax.transData.transform(line.get_xydata())[:, 1].max() for line in ax.lines[:4]
    )
    assert ax.get_legend().get_window_extent().y0 > highest


def test_response_is_area_change_per_excess_charge(table, ax):
    show.draw_response(table, ax, depth=100.0)
    assert has_units(ax)
    assert "10⁵ e⁻" in ax.get_ylabel()
    curves = [line for line in ax.lines if line.get_marker() != "None"]
    # Four pixels on each background; the level equal to the background has no response.
    assert len(curves) == 4 * len(BACKGROUNDS)
    centre, x_neighbour, y_neighbour, _ = curves[:4]
    areas = table.areas(charge=80_000, depth=100.0)
    wanted = (areas[REACH, REACH] - PITCH**2) / 0.8
    np.testing.assert_allclose(centre.get_xdata(), CHARGES[1:] / 1e3)
    assert centre.get_ydata()[-1] == pytest.approx(wanted, rel=1e-12)
    assert np.all(centre.get_ydata() < 0)
    # Larger along the parallel direction: [j, i] has not been read as [i, j].
    up, right = areas[REACH + 1, REACH], areas[REACH, REACH + 1]
    assert up > right + 0.01
    assert y_neighbour.get_ydata()[-1] == pytest.approx((up - PITCH**2) / 0.8, rel=1e-9)
    assert x_neighbour.get_ydata()[-1] == pytest.approx((right - PITCH**2) / 0.8, rel=1e-9)
    shown = [text.get_text() for text in ax.get_legend().get_texts()]
    assert len(shown) == 4 + len(BACKGROUNDS)


def test_depth_response_beside_the_guess_of_galsim(table, ax):
    show.draw_depth_response(table, ax, charge=80_000)
    assert "[µm]" in ax.get_xlabel() and "relative to 100 µm" in ax.get_ylabel()
    lines = {line.get_label(): line for line in ax.lines}
    levels = lines["table, levels"]
    np.testing.assert_allclose(levels.get_xdata(), DEPTHS)
    nominal = PITCH**2
    change = [table.areas(charge=80_000, depth=z)[REACH, REACH] - nominal for z in DEPTHS]
    np.testing.assert_allclose(
        levels.get_ydata(), np.array(change) / change[-1], rtol=1e-12
    )
    guess = lines["GalSim: tanh(z / 12 µm)"]
    np.testing.assert_allclose(guess.get_ydata(), np.tanh(guess.get_xdata() / 12.0))


def test_depth_response_refuses_a_charge_without_response(table, ax):
    with pytest.raises(TableError, match=r"charge = 0 e- .* changes no area"):
        show.draw_depth_response(table, ax, charge=0.0)


def test_area_changes_are_numbered_by_offset(table, ax):
    show.draw_area_changes(table, ax, charge=80_000, depth=100.0)
    changes = 1e3 * (table.areas(charge=80_000, depth=100.0) - PITCH**2)
    assert len(ax.texts) == (2 * REACH + 1) ** 2
    for text in ax.texts:
        i, j = text.get_position()
        value = changes[REACH + j, REACH + i]
        # Three significant digits, at most three decimals.
        assert float(text.get_text()) == pytest.approx(value, rel=0.006, abs=6e-4)
    assert has_units(ax)


def test_figure_for_table_fills_four_panels(table):
    figure = show.figure_for_table(table)
    assert len(figure.axes) == 4
    assert all("[" in ax.get_xlabel() for ax in figure.axes)
    figure.canvas.draw()


def test_missing_matplotlib_is_named(table, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] == "matplotlib":
            raise ModuleNotFoundError("No module named 'matplotlib'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    for draw in (
        lambda: show.figure_for_table(table),
        lambda: show.draw_response(table, None, depth=100.0),
        lambda: show.figure_for_device(Device.load("itl_sta3800c")),
    ):
        with pytest.raises(BFSensorError, match=r"pip install 'bfsensor\[plots\]'"):
            draw()
