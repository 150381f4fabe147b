"""Derivatives of potentials and boundaries: closed forms, and solutions of other devices."""

import dataclasses

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.parameters import change_parameter, device_parameters
from bfsensor.errors import DeviceError
from bfsensor.simulate.boundaries import TURN, find_boundaries
from bfsensor.simulate.boundary_tangent import boundary_changes
from bfsensor.simulate.mesh import LEAST, Surfaces, make_mesh, part_ends
from bfsensor.simulate.moved_mesh import move_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.tangent import Tangent
from bfsensor.simulate.unit_cell import tile
from bfsensor.units import VACUUM_PERMITTIVITY
from tests.simulate.cases import flat_device

LEVEL, CHARGE, PERIOD = 4e4, 5e3, 4
DEPTHS = 20.0, 50.0


class Solved:
    """A charge on a background, on a mesh that moves from that of another device."""

    def __init__(self, device, laid_for=None):
        model = laid_for or device
        fine, small = (
            move_mesh(make_mesh(model, pixels=(n, n), cells=8), model, device)
            for n in (PERIOD, 1)
        )
        self.small, self.solver = (
            Electrostatics(device, small),
            Electrostatics(device, fine),
        )
        empty = self.small.solve(0.0).phi
        self.unit = self.small.solve(LEVEL, start=empty, tolerance=1e-8)
        charges = np.full(self.solver.pixel_shape, LEVEL)
        charges[0, 0] += CHARGE
        self.potential = self.solver.solve(
            charges, start=tile(self.unit, fine), tolerance=1e-8
        )
        self.feet = []
        self.lines = find_boundaries(
            self.potential, DEPTHS, reach=1, precision=1e-9, turn=TURN, feet=self.feet
        )

    def change(self, name, step, **options):
        tangent = Tangent(self.solver, self.potential, Tangent(self.small, self.unit))
        changed = change_parameter(self.solver.device, name, step)
        return tangent.change(changed, step, **options)


@pytest.fixture(scope="module")
def itl():
    return Solved(Device.load("itl_sta3800c"))


NAMES = (
    "silicon.thickness", "gates.gate_oxide", "channel_stop.width", "channel.implant[1].dose",
    "operating_point.hole_quasi_fermi_level",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_solutions_and_boundaries_of_other_devices(itl, name):
    """Error of the difference: the third derivative, (0.02)^2 of it; asked: 2 %."""
    device = itl.solver.device
    spread = device_parameters(device)[name]
    change = itl.change(name, 1e-4 * spread)
    up, down = (
        Solved(change_parameter(device, name, s * 0.02 * spread), device) for s in (1, -1)
    )
    apart = 0.04 * spread
    wanted = (up.potential.phi - down.potential.phi) / apart
    error = np.abs(change.at_nodes - wanted).max()
    assert error < 2e-3 * np.abs(wanted).max()
    # What is not that of the uniform array moves boundaries: it must be right by itself.
    mesh = itl.solver.mesh
    uniform = (tile(up.unit, mesh) - tile(down.unit, mesh)) / apart
    found = change.at_nodes - tile(
        dataclasses.replace(itl.unit, phi=change.unit.at_nodes), mesh
    )
    difference = wanted - uniform
    assert np.abs(found - difference).max() < 0.02 * np.abs(difference).max()
    columns, rows = boundary_changes(itl.potential, itl.lines, itl.feet, [change])
    for lines, axis, one in (("columns", 0, columns), ("rows", 1, rows)):
        moved = (getattr(up.lines, lines) - getattr(down.lines, lines))[..., axis] / apart
        assert np.sqrt(np.mean((one[0, ..., axis] - moved) ** 2)) < 0.02 * np.sqrt(
            np.mean(moved**2)
        )


def test_paths_near_a_saddle():
    """E2V's rows end in cusps: steps over a saddle put single points 0.03 um a spread off."""
    device, name, step = Device.load("e2v_ccd250"), "channel.implant[0].dose", 20.0
    here = Solved(device)
    up, down = (Solved(change_parameter(device, name, s * step)) for s in (1, -1))
    change = here.change(name, 0.1)
    _, rows = boundary_changes(here.potential, here.lines, here.feet, [change])
    wanted = (up.lines.rows - down.lines.rows)[..., 1] / (2 * step)
    error = np.abs(rows[0, ..., 1] - wanted)
    assert error.max() < 0.2 * np.abs(wanted).max()
    assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(wanted**2))


def test_a_looser_system_is_worse(itl):
    """The tolerance is of what the uniform array leaves; at 0.3 little of that is found."""
    name = "channel.implant[1].dose"
    spread = device_parameters(itl.solver.device)[name]
    exact, loose, usual = (
        itl.change(name, 1e-4 * spread, **t).at_nodes
        for t in ({"tolerance": 1e-7}, {"tolerance": 0.3}, {})
    )
    assert 10 * np.abs(usual - exact).max() < np.abs(loose - exact).max()


@pytest.mark.parametrize("name", ["operating_point.back_bias", "silicon.background_doping"])
def test_a_capacitor(name):
    """Flat, depleted: charge between two plates behind an oxide, in closed form."""
    device = flat_device()
    solver = Electrostatics(device, make_mesh(device, pixels=(1, 1), cells=8))
    tangent = Tangent(solver, solver.solve(0.0))
    change = tangent.change(change_parameter(device, name, 1e-3), 1e-3, tolerance=1e-9)
    material, z = device.material, solver.mesh.z
    eps, oxide = (
        e * VACUUM_PERMITTIVITY
        for e in (material.permittivity_silicon, material.permittivity_oxide)
    )
    surface = Surfaces.of(device).silicon_channel
    depth, whole = np.maximum(z - surface, 0.0), z[-1] - surface
    resistance = np.minimum(z, surface) / oxide + depth / eps
    if name == "operating_point.back_bias":
        wanted = resistance / resistance[-1]
    else:
        # Displacement at the gate such that the back stays at its voltage.
        at_gate = (whole**2 / (2 * eps)) / resistance[-1]
        wanted = at_gate * resistance - depth**2 / (2 * eps)
    np.testing.assert_allclose(
        change.at_nodes[:, 2, 2], wanted, atol=1e-5 * np.abs(wanted).max()
    )


def test_nodes_stay_on_what_they_lie_on():
    device = Device.load("itl_sta3800c")
    mesh = make_mesh(device, pixels=(2, 2), cells=8)
    assert all(
        np.array_equal(getattr(move_mesh(mesh, device, device), a), getattr(mesh, a))
        for a in "xyz"
    )
    moved = device
    for name, by in (
        ("silicon.thickness", 3.0), ("gates.field_oxide", 0.1), ("channel_stop.width", 0.3),
        ("gates.field_oxide_taper", -0.2),
    ):  # fmt: skip
        moved = change_parameter(moved, name, by)
    there = move_mesh(mesh, device, moved)
    surfaces = Surfaces.of(moved)
    for height in (surfaces.gate_channel, surfaces.silicon_channel, surfaces.silicon_stop):
        assert np.abs(there.z - height).min() < 1e-9
    assert there.z[-1] == 103.0 and there.x[-1] == 10.0
    for x in (4.0 - 0.05, 6.05, 4.0 - 0.05 - 0.9):
        assert np.abs(there.x - x).min() < 1e-9
    assert all(np.all(np.diff(getattr(there, a)) > 0) for a in "xyz")


def test_meshes_that_cannot_move():
    device = Device.load("itl_sta3800c")
    mesh = make_mesh(device, pixels=(1, 1), cells=8)
    wide = dataclasses.replace(
        device, pixel=dataclasses.replace(device.pixel, pitch_x=12.0)
    )
    with pytest.raises(DeviceError, match=r"itl_sta3800c: .* pitch and gate pattern"):
        move_mesh(mesh, device, wide)
    equal = dataclasses.replace(
        device, gates=dataclasses.replace(device.gates, field_oxide_taper=0.0)
    )
    with pytest.raises(DeviceError, match=r"along x .* at \[0\.0, .*\] um"):
        move_mesh(mesh, device, equal)


@pytest.mark.parametrize("moves", [False, True])
def test_a_channel_stop_that_becomes_narrow_stays_solvable(moves):
    """Cells of 0.00005 um took 200 iterations a system, and a_10 was 18 % off."""
    device = Device.load("itl_sta3800c")
    found = []
    for width in (0.04, 1e-4):
        narrow = device.with_value("channel_stop.width", f"{width} um")
        mesh = make_mesh(device if moves else narrow, pixels=(1, 1), cells=16)
        if moves:
            mesh = move_mesh(mesh, device, narrow)
        assert np.diff(mesh.x).min() >= (LEAST / 4 if moves else LEAST) - 1e-9
        solver = Electrostatics(narrow, mesh)
        empty = solver.solve(0.0)
        assert max(step.linear_iterations for step in empty.history) < 40
        found.append(solver.solve(LEVEL, start=empty.phi).quasi_fermi[0, 0])
    # From 0.08 to 0.04 um the electrons' quasi-Fermi level moves by 0.022 V.
    assert abs(found[1] - found[0]) < 0.03


def test_edges_that_almost_coincide_share_a_node():
    device = Device.load("itl_sta3800c")
    almost = device.with_value("channel_stop.side_diffusion", "1.1004 um")
    one, other = (make_mesh(d, pixels=(1, 1), cells=16) for d in (device, almost))
    assert np.array_equal(one.x, other.x)
    assert len(part_ends([3.9, 3.91, 4.2], 5.0)) == 2
