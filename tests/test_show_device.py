"""Figures of solved devices: they draw what the solution holds, and labels carry units."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor import show
from bfsensor.device import Device
from bfsensor.errors import BFSensorError
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, solve_unit_cell, tile

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


def test_figure_for_device_draws_three_pages():
    figures = show.figure_for_device(Device.load("itl_sta3800c"))
    assert list(figures) == ["profiles", "sections", "paths"]
    for figure in figures.values():
        figure.canvas.draw()
    assert len(figures["profiles"].axes) == 6
    assert len(figures["paths"].axes) == 6
