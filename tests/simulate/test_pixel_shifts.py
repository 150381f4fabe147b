"""Shifts of whole pixels in the preconditioner: their energies, and the iterations that they save."""

import numpy as np
import pytest

from bfsensor.device.device import Device
from bfsensor.simulate import linear_system
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.simulate.pixel_shifts import PixelShifts
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile


def linearised(mesh, device):
    """The system of charged pixels, and what its shifts are made of."""
    solver = Electrostatics(device, mesh)
    charges = np.linspace(2e4, 5e4, np.prod(solver.pixel_shape)).reshape(solver.pixel_shape)
    charges.ravel()[-1] = 0.0
    start = tile(solve_unit_cell(device, 0.0, cells=mesh.cells), mesh)
    solution = solver.solve(charges, start=start, tolerance=1e-4)
    solver.imbalance(solution.phi, charges)
    solver.system.linearise()
    system = solver.system
    parts = (
        system.coefficients, system.pixels, system.multigrid, system.electrons,
        system.stiffness, system._kt, solver._counts(charges),
    )  # fmt: skip
    return system, parts


@pytest.mark.parametrize(
    "layout", [{}, {"symmetric": False}, {"centre": ("edge", "pixel")}], ids=str
)
def test_energies_are_those_of_the_matrix(layout):
    """The small matrix is W^T J W for the matrix J that the iteration applies."""
    device = Device.load("itl_sta3800c")
    mesh = make_mesh(device, pixels=(4, 3), cells=8, **layout)
    system, parts = linearised(mesh, device)
    conserved, shifts = parts[-1], PixelShifts(*parts)
    planes = shifts._profile.shape[1]
    shapes = []
    for p in np.flatnonzero(conserved > 0):
        y, x = divmod(p, len(shifts._x))
        w = np.zeros(system.shape)
        w[:, :planes] = shifts._profile * (shifts._y[y][:, None, None] * shifts._x[x])
        w[[0, -1]] = w[:, :, [0, -1]] = 0.0
        system.fill_halo(w)
        shapes.append(w)
    inner = np.s_[1:-1, :, 1:-1]
    expected = np.zeros((len(shapes), len(shapes)))
    for b, w in enumerate(shapes):
        system._apply(w, conserved, np.zeros(conserved.size))
        for a, v in enumerate(shapes):
            expected[a, b] = np.sum(v[inner] * system._product[inner])
    found = shifts._energies(*parts[:2], *parts[3:])
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())
    assert np.linalg.eigvalsh(expected).min() > 0


def test_windows_add_up_to_one():
    device = Device.load("itl_sta3800c")
    _, parts = linearised(make_mesh(device, pixels=(4, 3), cells=8), device)
    shifts = PixelShifts(*parts)
    for windows in (shifts._x, shifts._y):
        np.testing.assert_allclose(windows[:, 1:-1].sum(axis=0), 1.0, rtol=1e-14)


@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
def test_a_system_of_filled_pixels_takes_few_iterations(name, monkeypatch):
    """49 filled pixels have as many soft shifts, which conjugate gradients meet one by one."""
    array, other = (PixelArray(Device.load(name), period=12, cells=8) for _ in range(2))
    solution = array.solve(9.6e4, 4.4e4)
    charge = np.zeros(array.solver.system.shape)
    charge[25:33, 20, 25:33] = 1.0  # a packet on its way to the pixel three from the centre
    aided, with_shifts = array.solver.respond(solution, charge, tolerance=1e-6)
    monkeypatch.setattr(linear_system.LinearSystem, "_make_shifts", lambda *_: False)
    unaided, without = other.solver.respond(solution, charge, tolerance=1e-6)
    print(name, with_shifts, "iterations with shifts,", without, "without")
    assert with_shifts <= 0.6 * without
    np.testing.assert_allclose(aided, unaided, atol=1e-4 * np.abs(unaided).max())


def test_pixels_that_hold_next_to_nothing_are_no_matter():
    """As around a spot: from a full pixel to a thousandth of an electron, and none."""
    device = Device.load("e2v_ccd250")
    mesh = make_mesh(device, pixels=(10, 10), cells=8)
    solver = Electrostatics(device, mesh)
    j, i = np.indices(solver.pixel_shape)
    charges = 8e4 * np.exp(-0.9 * (i**2 + 1.1 * j**2))
    charges[charges < 1e-3] = 0.0
    start = tile(solve_unit_cell(device, 0.0, cells=8), mesh)
    solution = solver.solve(charges, start=start)
    np.testing.assert_allclose(solution.charges, charges)
    held = solution.electrons.sum() * 4
    whole = np.where(i > 0, 2, 1) * np.where(j > 0, 2, 1) * charges
    assert held == pytest.approx(whole.sum(), rel=1e-9)
    assert sum(step.linear_iterations for step in solution.history) < 60
