"""Figures of solved devices: they draw what the solution holds, and labels carry units."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.direct.transport import Transport
from bfsensor.errors import BFSensorError
from bfsensor.plots import table as show
from bfsensor.plots.style import BLUE, RED
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

PITCH = 10.0


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


def has_units(ax):
    return "[" in ax.get_xlabel() and "[" in ax.get_ylabel()


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


def collected(potential, **more):
    """Axes, segments from the lowest layer up, their colours and widths."""
    ax = new_figure().subplots()
    show.draw_collected_paths(potential, ax, **more)
    return ax, sorted(ax.collections, key=lambda c: c.get_zorder())


@pytest.mark.parametrize("plane", ["x", "y"])
def test_without_diffusion_each_pixel_collects_what_is_above_it(solved, plane):
    ax, (drawn,) = collected(solved[0], plane=plane, transport=Transport(diffusion=0.0))
    assert has_units(ax) and ax.get_xlabel().startswith(plane)
    assert "24 of 24 from above the centre" in ax.get_title()
    for path, colour in zip(drawn.get_segments(), drawn.get_colors(), strict=True):
        pixel = round(path[0, 0] / PITCH)
        assert round(path[-1, 0] / PITCH) == pixel
        assert matplotlib.colors.to_hex(colour) == (RED, BLUE)[abs(pixel)].lower()


def test_diffusion_spreads_paths_as_the_device_says(solved):
    """Half way down, by the drift in the mean field of the bulk of the same column."""
    empty, _ = solved
    count = 400
    _, (drawn,) = collected(empty, plane="x", paths=count, seed=9113)
    phi, z = empty.phi[:, 0, 0], empty.mesh.z
    assert len(drawn.get_segments()) == 3 * count
    # sigma^2 = 2 kT s, s = int dz / |E|; paths are drawn in steps of at most 0.5 um.
    heights = np.linspace(50.0, z[-1] - 1.0, 2001)
    slope = -np.gradient(np.interp(heights, z, phi), heights)
    kt = empty.device.material.thermal_voltage(empty.device.operating_point.temperature)
    wanted = np.sqrt(2 * kt * np.trapezoid(1 / slope, heights))
    off = np.array(
        [
            path[np.argmax(path[:, 1] < 50.0), 0] - path[0, 0]
            for path in drawn.get_segments()
        ]
    )
    wanted *= empty.device.diffusion
    # 3 sigma of 1200 widths: 6 %.
    assert off.std() == pytest.approx(wanted, rel=0.07)


def test_a_full_pixel_repels(solved):
    empty, filled = solved
    # Wider diffusion brings some that leave a neighbour.
    einstein = Transport(diffusion=1.0, part=0.1, longest=0.5)
    ax, (grey, drawn) = collected(
        filled, compare=empty, paths=100, plane="y", transport=einstein
    )
    widths = np.array(drawn.get_linewidths())
    moved = widths > 1
    assert moved.any() and f"black: {moved.sum()} to another pixel" in ax.get_title()
    ends = [round(path[-1, 0] / PITCH) for path in drawn.get_segments()]
    # All that change pixel along y leave the full one.
    assert all(ends[n] != 0 for n in np.nonzero(moved)[0])
    black = {matplotlib.colors.to_hex(c) for c in np.array(drawn.get_colors())[moved]}
    assert black == {"#222222"}

    def kept(axes):
        return int(axes.get_title().split("\n")[1].split()[0])

    hollow, _ = collected(empty, paths=100, plane="y", transport=einstein)
    assert kept(ax) < kept(hollow)
    # The same random numbers: in the potential they are compared with, all is the same.
    ax, (grey, drawn) = collected(empty, compare=empty)
    assert "black: 0 " in ax.get_title()
    for one, other in zip(grey.get_segments(), drawn.get_segments(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_collected_paths_refuse_another_plane(solved, ax):
    with pytest.raises(BFSensorError, match="plane = 'z' must be 'x' or 'y'"):
        show.draw_collected_paths(solved[0], ax, plane="z")


def test_figure_for_device_draws_four_pages():
    figures = show.figure_for_device(Device.load("itl_sta3800c"))
    assert list(figures) == ["profiles", "sections", "paths", "diffusion"]
    for figure in figures.values():
        figure.canvas.draw()
    assert len(figures["profiles"].axes) == 6
    assert len(figures["paths"].axes) == 6
    titles = [ax.get_title() for ax in figures["diffusion"].axes]
    assert len(titles) == 9
    for drift, diffusion, repulsion in (titles[0:3], titles[3:6], titles[6:9]):
        assert drift.startswith("drift along") and "empty" in drift
        assert diffusion.startswith("drift and diffusion along") and "empty" in diffusion
        assert "000 e" in repulsion and "to another pixel" in repulsion
