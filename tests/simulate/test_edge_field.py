"""The field of an edge against closed forms and the three-dimensional solver."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bfsensor import Device
from bfsensor.device.parts import Edge, EdgeStrip, Implant, Ripple
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.edge_field import front_plane, solve_edge
from bfsensor.simulate.edge_shift import trace_edge
from bfsensor.simulate.edge_system import FrontPlane
from bfsensor.simulate.mesh import Surfaces, make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.units import VACUUM_PERMITTIVITY

ITL = Device.load("itl_sta3800c")
SURFACE = Surfaces.of(ITL).silicon_stop
BACK = ITL.operating_point.back_bias
PERMITTIVITY = ITL.material.permittivity_silicon * VACUUM_PERMITTIVITY


def with_strips(*strips, device=ITL, side="x", **silicon):
    silicon = dataclasses.replace(device.silicon, **silicon)
    return dataclasses.replace(
        device, silicon=silicon, edge=Edge(side, strips), provenance={}
    )


def contact(voltage, width=400.0):
    return EdgeStrip(width, voltage, "none")


PIXELS = FrontPlane(SURFACE, 6.0)
DOPED = -2.4


class Step:
    """Two half planes at different voltages opposite the back: conformal map of a strip.

    w = exp(pi (x + i z) / T) maps it to the upper half plane, where the part of the boundary
    beyond w = 1 is seen from w under the angle pi - arg(w - 1).
    """

    def __init__(self, outside, inside, doping):
        self.height = ITL.silicon.thickness - SURFACE
        self.outside, self.inside, self.curve = outside, inside, doping / PERMITTIVITY

    def potential(self, x, z):
        z = z - SURFACE
        angle = np.angle(np.exp(np.pi * (x + 1j * z) / self.height) - 1)
        share = 1 - np.abs(angle) / np.pi  # round-off turns its sign at the back
        plate = BACK * z / self.height + 0.5 * self.curve * z * (self.height - z)
        share_outside = 1 - z / self.height - share
        return plate + self.inside * share + self.outside * share_outside

    def gradient(self, x, z):
        w = np.exp(np.pi * (x + 1j * (z - SURFACE)) / self.height)
        turn = w / (w - 1) / self.height  # d arg(w - 1) / dx = Im, / dz = Re
        step = self.inside - self.outside
        plate = (BACK - self.outside) / self.height
        plate += self.curve * (0.5 * self.height - (z - SURFACE))
        return -step * turn.imag, plate - step * turn.real


@pytest.mark.parametrize("doping", [0.0, DOPED])
def test_potential_of_a_step_of_voltage(doping):
    exact = Step(20.0, PIXELS.potential, doping)
    device = with_strips(contact(20.0), background_doping=doping)
    errors = []
    for refine in (0, 1):
        edge = solve_edge(device, front=PIXELS, refine=refine)
        x, z = np.meshgrid(edge.x, edge.z)
        away = (np.hypot(x, z - SURFACE) > 5.0) & (x > -200) & (x < 200)
        errors.append(np.abs(edge.phi - exact.potential(x, z))[away].max())
        assert not edge.neutral.any()
    # The jump at the corner sits between two nodes (0.2 um, then half of it): an error of the
    # order of 14 V * 0.1 um / (pi * 5 um), which halves.
    assert errors[0] < 0.1
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("outside", [20.0, -5.0])
def test_shifts_by_a_step_of_voltage(outside):
    exact = Step(outside, PIXELS.potential, DOPED)
    device = with_strips(contact(outside), background_doping=DOPED)
    device = dataclasses.replace(
        device, operating_point=dataclasses.replace(
            device.operating_point, hole_quasi_fermi_level=-20.0
        ),
    )  # fmt: skip
    depths = [30.0, 60.0, 100.0]
    found = []
    for refine in (0, 1):
        edge = solve_edge(device, front=PIXELS, refine=refine)
        found.append(trace_edge(edge, depths).shifts[:, 2:31])

    def slope(z, x):
        along, up = exact.gradient(x, z)
        return along / up

    starts = 10.0 * np.arange(2, 31)
    path = solve_ivp(slope, (SURFACE, 100.0), starts, t_eval=depths, rtol=1e-9, atol=1e-9)
    expected = path.y.T - starts
    assert np.abs(expected[2, 0]) > 2.0
    assert np.all(np.sign(expected) == np.sign(outside - PIXELS.potential))
    # Largest at the pixel next to the strips, 20 um away: a jump misplaced by 0.1 um is 0.5 % there.
    assert found[0] == pytest.approx(expected, rel=0.01, abs=1e-4)
    assert found[1] == pytest.approx(expected, rel=0.005, abs=1e-4)


def test_no_step_shifts_nothing():
    device = with_strips(contact(PIXELS.potential))
    shift = trace_edge(solve_edge(device, front=PIXELS), [50.0, 100.0])
    assert np.abs(shift.shifts).max() < 1e-6
    assert shift.shadowed == 0


def test_shifts_fall_by_the_thickness_over_pi_and_turn_with_the_voltage():
    front = front_plane(ITL)
    shifts = {}
    for voltage in (2.0, 20.0):
        edge = solve_edge(with_strips(contact(voltage)), front=front)
        shifts[voltage] = trace_edge(edge, [100.0]).pixel_shifts[0]
    fall = np.exp(-np.pi * 10.0 / (100.0 - front.height))
    for shift in shifts.values():
        assert shift[16:25] / shift[15:24] == pytest.approx(fall, rel=0.01)
    assert shifts[2.0][5] < 0 < shifts[20.0][5]


@pytest.mark.parametrize("side", ["x", "y"])
def test_pixels_answer_like_the_front_plane(side):
    """Against all wells and stops solved in three dimensions, in a field that doping modulates.

    A ripple of the doping with period 2 pi / k displaces the field lines.  With the pixels as a
    plane its potential is (N a / eps k^2) [1 - (sinh k(L - z) + sinh kz) / sinh kL] cos kx.
    """
    period, amplitude, depths = 16, 0.03, np.array([20.0, 50.0, 100.0])
    direction = 0.0 if side == "x" else np.pi / 2
    ripple = Ripple("plane", amplitude, 10.0 * period, direction=direction)
    bent = dataclasses.replace(
        ITL, silicon=dataclasses.replace(ITL.silicon, ripples=(ripple,)), provenance={}
    )
    shape = (period, 4) if side == "x" else (4, period)
    mesh = make_mesh(bent, pixels=shape, cells=8, symmetric=False)
    lines = find_boundaries(Electrostatics(bent, mesh).solve(0.0), depths, reach=1)
    places = lines.columns[..., 0] if side == "x" else lines.rows[..., 1]
    edges = np.array([-15.0, -5.0, 5.0, 15.0])
    found = places.mean(-1) - edges

    front, doping = front_plane(ITL), ITL.silicon.background_doping
    length, k = 100.0 - front.height, 2 * np.pi / (10.0 * period)
    z = np.linspace(0.0, length, 4001)
    up = (BACK - front.potential) / length + doping / PERMITTIVITY * (length / 2 - z)
    size = doping * amplitude / (PERMITTIVITY * k**2)
    size = size * (1 - (np.sinh(k * (length - z)) + np.sinh(k * z)) / np.sinh(k * length))
    slope = -k * size / up
    total = np.concatenate([[0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(z))])
    expected = np.outer(np.interp(depths - front.height, z, total), np.sin(k * edges))
    assert np.abs(expected[-1]).max() > 0.1
    # What is left is made within a pixel of the front: it counts less from further up.
    for d, tolerance in enumerate((0.06, 0.015, 0.005)):
        assert found[d] == pytest.approx(expected[d], rel=tolerance), depths[d]


def test_undepleted_silicon_stays_at_the_back_bias():
    doping = -20.0
    device = with_strips(
        contact(20.0, 300.0), EdgeStrip(400.0, implants=(Implant("box", -1e4, depth=1.0),)),
        background_doping=doping,
    )  # fmt: skip
    edge = solve_edge(device, front=PIXELS)
    far = edge.phi[:, edge.x < -600]
    assert far[edge.z > SURFACE + 5.0] == pytest.approx(BACK, abs=1e-3)
    # Under the strip: depleted to sqrt(2 eps V / N), less about kT / V of it.
    column = np.argmin(np.abs(edge.x + 150.0))
    depleted = edge.z[~edge.neutral[:, column]]
    width = np.sqrt(2 * PERMITTIVITY * (20.0 - BACK) / -doping)
    assert depleted[depleted < 99.0].max() - SURFACE == pytest.approx(width, abs=2.5)
    with pytest.raises(DeviceError, match=r"not depleted up to \d+ um from the edge"):
        trace_edge(edge, [90.0])


def test_a_strip_behind_oxide_sees_its_implants():
    dose, peak = 3e3, 0.5
    implant = Implant("gaussian", dose, peak=peak, sigma=0.1)
    device = with_strips(EdgeStrip(400.0, 2.0, "field", (implant,)), background_doping=0.0)
    edge = solve_edge(device, front=PIXELS)
    material = device.material
    oxide = device.gates.field_oxide / (material.permittivity_oxide * VACUUM_PERMITTIVITY)
    # One dimension: what leaves the gate, eps g + dose, crosses the oxide; 0.4 um of silicon
    # are below the implant.
    length = 100.0 - SURFACE
    g = (BACK - 2.0 + -dose * (oxide + peak / PERMITTIVITY)) / (
        length + PERMITTIVITY * oxide
    )
    column = np.argmin(np.abs(edge.x + 300.0))
    found = (edge.phi[-1, column] - edge.phi[-5, column]) / (edge.z[-1] - edge.z[-5])
    assert found == pytest.approx(g, rel=2e-4)


def test_pixels_without_light():
    edge = solve_edge(with_strips(contact(45.0, 50.0), EdgeStrip(200.0)))
    shift = trace_edge(edge, [50.0, 100.0])
    assert shift.shadowed >= 1
    assert shift.area_changes[:, : shift.shadowed] == pytest.approx(-1.0)
    assert np.all(shift.area_changes[:, shift.shadowed :] > -1.0)


def test_edges_along_y_count_in_rows():
    tall = dataclasses.replace(ITL.pixel, pitch_y=12.0)
    device = dataclasses.replace(ITL, pixel=tall, provenance={})
    edge = solve_edge(with_strips(contact(20.0), device=device, side="y"), front=PIXELS)
    shift = trace_edge(edge, [100.0])
    assert (shift.side, shift.pitch) == ("y", 12.0)


@pytest.mark.parametrize(
    ("device", "options", "message"),
    [
        (ITL, {}, "edge: there are no strips"),
        (with_strips(), {}, "edge: there are no strips"),
        (with_strips(contact(5.0)), {"pixels": 3}, "pixels = 3 from the edge inward"),
        (with_strips(contact(5.0)), {"refine": -1}, "refine = -1 must not be negative"),
        (with_strips(contact(5.0), background_doping=1.0), {}, "1e\\+12 cm-3 is n-type"),
        (
            with_strips(contact(5.0), ripples=(Ripple("plane", 0.1, 100.0),)), {},
            "ripples and an edge are not solved together",
        ),
        (
            with_strips(contact(5.0), contact(-51.0)), {},
            r"edge.strip\[1\]: voltage = '-51 V' must not be below back_bias = '-50 V'",
        ),
        (
            with_strips(
                EdgeStrip(9.0, 5.0, "none", (Implant("box", 1.0, depth=1.0),))
            ), {}, r"edge.strip\[0\]: oxide = 'none' with a voltage is a contact",
        ),
        (
            with_strips(EdgeStrip(9.0, 5.0, "gate", (Implant("box", 1.0, depth=60.0),))), {},
            r"edge.strip\[0\]: an implant that ends 60 um deep",
        ),
        (with_strips(EdgeStrip(200.0)), {}, "below the holes of the channel stops"),
        (with_strips(contact(-3.0)), {}, "falls to -3 V, below the holes"),
    ],
)  # fmt: skip
def test_refusals(device, options, message):
    with pytest.raises(DeviceError, match=message):
        solve_edge(device, front=PIXELS, **options)


def test_refused_depths():
    edge = solve_edge(with_strips(contact(20.0)), front=PIXELS, pixels=5)
    for depths, message in (
        ([50.0, 50.0], "must ascend"), ([0.5, 50.0], "depth 0.5 um must lie"),
        ([50.0, 101.0], "depth 101 um must lie"),
    ):  # fmt: skip
        with pytest.raises(DeviceError, match=message):
            trace_edge(edge, depths)


def test_unconverged_holes_are_refused(monkeypatch):
    monkeypatch.setattr("bfsensor.simulate.edge_system._MAX_NEWTON", 3)
    device = with_strips(contact(20.0, 50.0), EdgeStrip(300.0))
    with pytest.raises(ConvergenceError, match=r" 3 steps \(last .* V\)") as caught:
        solve_edge(device, front=PIXELS)
    assert len(caught.value.history) == 3


def test_a_device_file_describes_the_edge():
    device = Device.load(
        Path(__file__).parents[2] / "validation" / "edges" / "decam_like.toml"
    )
    assert Device.from_toml(device.to_toml()) == device
    edge = solve_edge(device)
    shift = trace_edge(edge, [250.0])
    # A ring below the pixels' potential draws light in from beyond the array.
    assert edge.front.potential > 5.0
    assert np.all(shift.area_changes[0, :20] > 0)
