"""Free holes at the surface, pinned under low gates, against references that share no mesh.

The references, with cells of 0.25 nm and in two dimensions of 2 nm, integrate Poisson's equation on
planes of their own by scipy's sparse matrices; they take from the package what a device is: implants,
material laws, voltages.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

from bfsensor.device.device import Device
from bfsensor.device.parts import BuriedChannel, ChannelStop, GateStack, Implant
from bfsensor.simulate.discretise import carrier_region
from bfsensor.simulate.hole_layer import hole_layer_error
from bfsensor.simulate.mesh import Surfaces, make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell
from bfsensor.units import VACUUM_PERMITTIVITY

CHANNEL = (Implant("gaussian", 9600.0, peak=0.1, sigma=0.15),)
"""Close to the ITL device's channel: 5 V beside the surface."""


def striped_device(low: float, high: float, holes: float) -> Device:
    """A channel without stops under gates that alternate along y, 4 phases of which 2 collect."""
    device = Device.load("itl_sta3800c")
    return dataclasses.replace(
        device,
        name="striped",
        channel=BuriedChannel(0.0, CHANNEL),
        channel_stop=ChannelStop(0.0),
        gates=GateStack(4, 2, 0.1, 0.1),
        operating_point=dataclasses.replace(
            device.operating_point,
            gate_low=low,
            gate_high=high,
            hole_quasi_fermi_level=holes,
        ),
        provenance={},
    )


def planes(surface: float, top: float, finest: float) -> np.ndarray:
    """Heights [um]: oxide in 12 cells, silicon from ``finest`` at the surface up to 1 um apart."""
    steps, height = [], surface
    while height < top:
        steps.append(min(finest * 1.03 ** len(steps), 1.0))
        height += steps[-1]
    steps = np.array(steps) * (top - surface) / sum(steps)
    return np.r_[np.linspace(0, surface, 13)[:-1], surface, surface + np.cumsum(steps)]


def reference(
    device: Device, y: np.ndarray, finest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Heights and potential, shape (z, y), of a device uniform in x without electrons.

    Finite volumes of half a cell at mirrors in y; Newton's method, steps limited to 0.2 V.
    """
    surface, top = Surfaces.of(device).silicon_channel, device.silicon.thickness
    z = planes(surface, top, finest)
    eps = VACUUM_PERMITTIVITY * np.where(
        0.5 * (z[1:] + z[:-1]) < surface,
        device.material.permittivity_oxide,
        device.material.permittivity_silicon,
    )
    nz, ny = len(z), len(y)
    wide = np.zeros(ny)
    np.add.at(wide, np.arange(ny - 1), 0.5 * np.diff(y))
    np.add.at(wide, np.arange(1, ny), 0.5 * np.diff(y))
    if ny == 1:
        wide[:] = 1.0
    tall = np.zeros(nz)
    np.add.at(tall, np.arange(nz - 1), 0.5 * np.diff(z))
    np.add.at(tall, np.arange(1, nz), 0.5 * np.diff(z))
    faces = np.clip(np.r_[z[0], 0.5 * (z[1:] + z[:-1]), z[-1]], surface, top) - surface
    fixed = np.diff(
        sum(np.asarray(i.cumulative(faces)) for i in device.channel.implants)
        + device.silicon.background_doping * faces
    )
    silicon = np.diff(faces)
    silicon[z > carrier_region(device)] = 0.0
    number = np.arange(nz * ny).reshape(nz, ny)
    links = [
        (number[:-1].ravel(), number[1:].ravel(), np.outer(eps / np.diff(z), wide).ravel())
    ]
    if ny > 1:
        level = np.zeros(nz)
        level[:-1] += 0.5 * np.diff(z) * eps
        level[1:] += 0.5 * np.diff(z) * eps
        links.append(
            (
                number[:, :-1].ravel(),
                number[:, 1:].ravel(),
                np.outer(level, 1 / np.diff(y)).ravel(),
            )
        )
    a, b, c = (np.concatenate(part) for part in zip(*links, strict=True))
    matrix = csr_array(
        (np.r_[c, c, -c, -c], (np.r_[a, b, a, b], np.r_[a, b, b, a])), shape=(nz * ny,) * 2
    )
    point = device.operating_point
    kt = device.material.thermal_voltage(point.temperature)
    ni = device.material.intrinsic_density(point.temperature)
    edge = device.gates.edges_y(device.pixel.pitch_y)[1]
    gate = np.where(y < edge - 1e-9, point.gate_high, point.gate_low)
    gate = np.where(np.abs(y - edge) < 1e-9, 0.5 * (point.gate_high + point.gate_low), gate)
    held = np.zeros((nz, ny), bool)
    held[0], held[-1] = True, True
    phi = np.linspace(gate, point.back_bias, nz)
    free = ~held.ravel()
    phi[1:-1] = np.maximum(phi[1:-1], point.hole_quasi_fermi_level)
    volume = np.outer(silicon, wide)
    for _ in range(400):
        holes = (
            ni
            * np.exp(np.minimum((point.hole_quasi_fermi_level - phi) / kt, 60.0))
            * volume
        )
        residual = np.outer(fixed, wide) + holes - (matrix @ phi.ravel()).reshape(nz, ny)
        system = matrix + diags_array(holes.ravel() / kt)
        step = np.zeros(nz * ny)
        step[free] = spsolve(system[free][:, free].tocsc(), residual.ravel()[free])
        phi += np.clip(step, -0.2, 0.2).reshape(nz, ny)
        if np.abs(step).max() < 1e-9:
            return z, phi
    raise AssertionError("the reference does not converge")


def channel_top(phi: np.ndarray) -> np.ndarray:
    """Largest potential over each place [V]."""
    return np.asarray(phi.max(axis=0))


@pytest.fixture(scope="module")
def column() -> dict[float, np.ndarray]:
    """Reference along z under a gate of -8 V: largest potential, and that of the surface.

    For three levels of the holes.
    """
    out = {}
    for level in (-40.0, 0.0, 2.0):
        device = striped_device(-8.0, -8.0 + 1e-9, level)
        fine, finer = (reference(device, np.zeros(1), h) for h in (5e-4, 2.5e-4))
        assert abs(channel_top(fine[1])[0] - channel_top(finer[1])[0]) < 3e-4
        z, phi = finer
        out[level] = np.array([channel_top(phi)[0], phi[np.argmin(np.abs(z - 0.1)), 0]])
    return out


def ours(low: float, high: float, level: float, refine: int, cells: int = 8):
    return solve_unit_cell(
        striped_device(low, high, level), 0.0, cells=cells, refine_z=refine
    )


def test_without_holes_the_error_falls_with_the_square_of_the_planes(column) -> None:
    errors = [
        ours(-8.0, -8.0 + 1e-9, -40.0, n).phi[:, 0, 0].max() - column[-40.0][0]
        for n in (0, 1, 2)
    ]
    assert abs(errors[0]) < 0.02
    # Planes four times as fine: a sixteenth, and twice the reference's own error of 1.5e-4 V.
    assert abs(errors[2]) < 0.15 * abs(errors[0]) + 3e-4


def test_a_layer_of_holes_is_right_to_the_width_of_its_first_cell(column) -> None:
    """Holes sit in a layer of 1 to 3 nm, which a cell of 25 nm holds as a sheet in its first node."""
    kt = Device.load("itl_sta3800c").material.thermal_voltage(173.0)
    errors = np.array([
        ours(-8.0, -8.0 + 1e-9, 0.0, n).phi[:, 0, 0].max() - column[0.0][0] for n in (0, 1, 2, 3)
    ])  # fmt: skip
    # The sheet of a cell h has kT ln(h / layer) less drive: a logarithm that halving h lowers by 10 mV.
    assert np.abs(errors).max() < 4.5 * kt
    assert np.all(np.abs(np.diff(errors)) < np.log(2) * kt * 1.6)
    assert np.all(np.diff(np.abs(errors)) < 0)


def test_a_change_of_the_hole_level_acts_as_in_the_reference(column) -> None:
    """The level moves the pinned surface by as much, whatever the cell: its effect is exact."""
    wanted = column[2.0][0] - column[0.0][0]
    assert wanted > 0.2
    for refine in (0, 1):
        found = (
            ours(-8.0, -8.0 + 1e-9, 2.0, refine).phi[:, 0, 0].max()
            - ours(-8.0, -8.0 + 1e-9, 0.0, refine).phi[:, 0, 0].max()
        )
        assert found == pytest.approx(wanted, rel=5e-3)


def test_the_stated_error_is_that_of_the_surface(column) -> None:
    for refine in (0, 1, 2):
        mine = ours(-8.0, -8.0 + 1e-9, 0.0, refine)
        surface = mine.phi[np.argmin(np.abs(mine.mesh.z - 0.1)), 0, 0]
        assert hole_layer_error(mine) == pytest.approx(surface - column[0.0][1], rel=0.16)
    assert hole_layer_error(ours(-8.0, -8.0 + 1e-9, -40.0, 0)) == 0.0


@pytest.mark.slow
def test_beside_a_gate_without_holes_the_level_acts_as_in_two_dimensions() -> None:
    """Barrier gates at -8 V hold holes, collecting gates at +2 V none: the field between the two.

    Halving the cells from 16 to 32 a pixel lowers the error from 10 to 2 % under the collecting gate.
    """
    y = np.round(np.arange(0, 5.0001, 0.1), 6)
    devices = [striped_device(-8.0, 2.0, level) for level in (0.0, 2.0)]
    tops = [channel_top(reference(device, y, 2e-3)[1]) for device in devices]
    wanted = tops[1] - tops[0]
    under_barrier, under_gate = y > 4.0, y < 1.5
    errors = []
    for cells in (16, 32):
        solved = []
        for device in devices:
            mesh = make_mesh(device, pixels=(1, 1), cells=cells)
            phi = Electrostatics(device, mesh).solve(0.0).phi[:, :, 0]
            solved.append(np.interp(y, mesh.y, phi.max(0)))
        change = solved[1] - solved[0]
        assert change[under_barrier] == pytest.approx(wanted[under_barrier], rel=0.02)
        errors.append(float(np.abs(change / wanted - 1)[under_gate].max()))
    assert errors[0] < 0.12
    assert errors[1] < 0.025
