"""Figures: what they print and draw is what the data hold, and labels carry units."""

from __future__ import annotations

import builtins

import numpy as np
import pytest

from bfsensor import show
from bfsensor.device import Device
from bfsensor.errors import BFSensorError, TableError
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, solve_unit_cell, tile
from bfsensor.table import DistortionTable, vertex_fractions

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


@pytest.fixture(scope="module")
def solved():
    """An empty and a filled pixel on a coarse small period: (empty, filled)."""
    device = Device.load("itl_sta3800c")
    mesh = make_mesh(device, pixels=(4, 4), cells=16)
    solver = Electrostatics(device, mesh)
    empty = solver.solve(0.0, start=tile(solve_unit_cell(device, 0.0, cells=16), mesh))
    charges = np.zeros(solver.pixel_shape)
    charges[0, 0] = 80_000.0
    return empty, solver.solve(charges, start=empty.phi)


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


def test_profiles_hold_the_potential_and_carriers(solved):
    empty, filled = solved
    axes = new_figure().subplots(2, 3)
    show.draw_potential_profiles(filled, axes, empty=empty)
    assert all(has_units(ax) for ax in axes.ravel())
    full, hollow = axes[0, 0].lines[:2]
    z = filled.mesh.z
    np.testing.assert_array_equal(
        full.get_ydata(), filled.phi[np.isin(z, full.get_xdata()), 0, 0]
    )
    # Stored electrons pull the well down by volts.
    assert hollow.get_ydata().max() > full.get_ydata().max() + 1.0
    inset = axes[0, 0].child_axes[0].lines[0]
    assert inset.get_xdata()[-1] == pytest.approx(filled.device.silicon.thickness)
    assert inset.get_ydata()[-1] == pytest.approx(filled.device.operating_point.back_bias)

    densities = [
        {line.get_label(): line.get_ydata() for line in ax.lines} for ax in axes[1]
    ]
    collecting, stop, barrier = densities
    volume = filled.silicon[:, 0, 0]
    wanted = (filled.electrons[:, 0, 0] / np.where(volume > 0, volume, np.inf)).max()
    assert collecting["electrons"].min() == pytest.approx(-wanted, rel=1e-12)
    assert stop["electrons"].min() == barrier["electrons"].min() == 0.0
    # Donors in the channel, acceptors and the holes that answer them in the stop.
    assert collecting["dopants"].max() > 1e3 and stop["dopants"].min() < -1e3
    assert stop["holes"].max() > 1e3 > collecting["holes"].max()


def test_drawn_dopants_are_those_of_the_solver(solved):
    """Neutral stop: where holes are many, they equal the acceptors that are drawn."""
    _, filled = solved
    axes = new_figure().subplots(2, 3)
    show.draw_potential_profiles(filled, axes)
    lines = {line.get_label(): line for line in axes[1, 1].lines}
    z, holes = lines["holes"].get_data()
    acceptors = -np.interp(z, *lines["dopants"].get_data())
    many = holes > 0.5 * holes.max()
    assert many.sum() > 3
    # The potential is flat there to kT over the width; node cells average a few percent.
    np.testing.assert_allclose(holes[many], acceptors[many], rtol=0.1)


def test_cross_sections_show_holes_and_electrons_over_the_pixel(solved):
    _, filled = solved
    figure = new_figure()
    show.draw_charge_cross_sections(filled, figure)
    panels, bars = figure.axes[:3], figure.axes[3:]
    assert len(bars) == 2
    assert all("µm⁻³" in bar.get_ylabel() for bar in bars)
    assert all(has_units(ax) for ax in panels)
    assert [ax.get_xlabel()[0] for ax in panels] == ["x", "x", "y"]
    from matplotlib.collections import QuadMesh

    for ax, has_electrons in zip(panels, (True, False, True), strict=True):
        meshes = [c for c in ax.collections if isinstance(c, QuadMesh)]
        holes, electrons = (c.get_array() for c in meshes)
        assert (electrons.count() > 0) == has_electrons
        # Mirrored about the centre of the pixel.
        np.testing.assert_array_equal(electrons.filled(0), electrons.filled(0)[:, ::-1])
        assert ax is panels[2] or holes.count() > 0
        assert ax.get_xlim() == pytest.approx((-15.0, 15.0))


@pytest.mark.parametrize("plane", ["x", "y"])
def test_paths_run_from_the_light_side_to_a_well(solved, plane):
    ends = []
    for potential in solved:
        ax = new_figure().subplots()
        show.draw_electron_paths(potential, ax, plane=plane, paths=8)
        assert has_units(ax) and ax.get_xlabel().startswith(plane)
        segments = ax.collections[0].get_segments()
        assert len(segments) == 3 * 8
        for path in segments:
            assert path[0, 1] == pytest.approx(potential.mesh.z[-1] - 1.0)
            assert path[-1, 1] < 2.5
            # Arrived within a gate's or channel's width of a pixel centre.
            offset = path[-1, 0] - PITCH * round(path[-1, 0] / PITCH)
            assert abs(offset) < 0.4 * PITCH
        ends.append([np.interp(8.0, s[::-1, 1], s[::-1, 0]) for s in segments])
    # Stored charge repels: paths of the central pixel are farther out at 8 um.
    out = np.abs(ends[1][:8]) - np.abs(ends[0][:8])
    assert out.min() > 0


def test_paths_refuse_another_plane(solved, ax):
    with pytest.raises(BFSensorError, match="plane = 'z' must be 'x' or 'y'"):
        show.draw_electron_paths(solved[0], ax, plane="z")


def test_figure_for_device_draws_three_pages():
    figures = show.figure_for_device(Device.load("itl_sta3800c"))
    assert list(figures) == ["profiles", "sections", "paths"]
    for figure in figures.values():
        figure.canvas.draw()
    assert len(figures["profiles"].axes) == 6
    assert len(figures["paths"].axes) == 6


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
