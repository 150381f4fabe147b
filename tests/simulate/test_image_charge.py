"""Displacements by the analytic engine against quadrature, modes, Gauss' law and ray tracing."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp, trapezoid

from bfsensor.errors import TableError
from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate import image_charge as engine
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.far_field import FarField
from bfsensor.simulate.image_charge import (
    area_changes,
    displace_boundaries,
    edge_shifts,
    trace_boundaries,
)
from bfsensor.units import VACUUM_PERMITTIVITY
from tests.simulate.cases import charge_field

MODEL = ImageCharge(
    0.5, 1.4, 3.2, 1.5, 3.0, pitch_x=10.0, pitch_y=12.0, drift_field=((0, 0.75), (100, 0.37))
)  # fmt: skip
EPSILON = MODEL.permittivity * VACUUM_PERMITTIVITY
T = 100.0


def points_between(seed, count=40, lateral=40.0, low=0.0, high=T):
    rng = np.random.default_rng(seed)
    at = rng.uniform(-lateral, lateral, (count, 3))
    at[:, 2] = rng.uniform(low, high, count)
    return at


# -- displacements -----------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("depth", [6.0, 30.0, T])
def test_shifts_are_the_integral_of_the_field(axis, depth):
    """Adaptive quadrature of the field over the drift field, straight down."""
    lines = displace_boundaries(MODEL, [depth], charge=1.0, reach=1)
    line = (lines.columns, lines.rows)[axis][0, 2]
    seal = (MODEL.column_height, MODEL.row_height)[axis]
    pitch = (MODEL.pitch_x, MODEL.pitch_y)[axis]
    for point in line[:: len(line) // 5]:
        at = np.array([0.0, 0.0, 0.0])
        at[axis], at[1 - axis] = pitch / 2, point[1 - axis]

        def slope(z, at=at):
            at[2] = z
            return 1e9 * charge_field(MODEL, at)[axis] / MODEL.drift_at(z)

        wanted = quad(slope, seal, depth, epsrel=1e-10, epsabs=0, limit=200)[0]
        # Positions of 5 um hold 1e-15 um, 1e-9 of shifts of 1e-6 um.
        assert 1e9 * (point[axis] - pitch / 2) == pytest.approx(wanted, rel=1e-8, abs=2e-6)


def test_edges_are_the_mean_of_their_lines():
    shifts = edge_shifts(MODEL, depth=T, reach=1)
    lines = displace_boundaries(MODEL, [T], charge=1.0, reach=1, samples=400)
    for line, axis, across, along, found in (
        (lines.columns[0, 2], 0, 10.0, 12.0, shifts.east[1, 1]),
        (lines.rows[0, 2], 1, 12.0, 10.0, shifts.north[1, 1]),
    ):
        at, moved = line[:, 1 - axis], line[:, axis] - across / 2
        use = np.abs(at) < along / 2
        mean = trapezoid(moved[use], at[use]) / np.ptp(at[use])
        # Ends left out: 1e-5 of the side; trapezoids of 400 points.
        assert mean / across == pytest.approx(found, rel=1e-4)


@pytest.mark.parametrize(
    ("depth", "moved"), [(1.4, (0, 0)), (2.0, (0, 1)), (3.2, (0, 1)), (4.0, (1, 1))]
)
def test_nothing_moves_below_the_sealed_heights(depth, moved):
    shifts = edge_shifts(MODEL, depth=depth, reach=1)
    assert np.any(shifts.east != 0) == moved[0]
    assert np.any(shifts.north != 0) == moved[1]


def test_repulsion_and_the_order_of_the_lags():
    """The source shrinks, all others grow, more along the columns, sealed lower."""
    a = area_changes(MODEL, depth=T, reach=4)[4:, 4:]
    assert a[0, 0] < 0
    assert np.all(np.delete(a.ravel(), 0) > 0)
    assert a[1, 0] > a[0, 1]
    # Without charge nearer to the rows, and sealed alike, the order turns with the pitch.
    even = dataclasses.replace(
        MODEL,
        column_height=1.4,
        half_width_x=2.0,
        half_width_y=2.0,
        pitch_x=12.0,
        pitch_y=12.0,
    )
    even = area_changes(even, depth=T, reach=2)
    assert even[3, 2] == even[2, 3]


@pytest.mark.parametrize("depth", [5.0, 20.0, T])
@pytest.mark.parametrize("reach", [2, 4])
def test_areas_sum_to_the_flux_through_the_rim(depth, reach):
    """Pixels share edges: only the rim of the window is left, and Gauss has that flux.

    The slab from the sealed height to the conversion depth holds no charge: what leaves
    through its rim comes in through its faces.  It is the field that the missing pixels
    would have gained from.
    """
    model = dataclasses.replace(MODEL, column_height=1.4, drift_field=0.6)
    a = area_changes(model, depth=depth, reach=reach)
    x, y = (reach + 0.5) * 10.0, (reach + 0.5) * 12.0

    def through(z, n=240):
        # Half points are within 10 um, where the field is steep: node = t^3 there.
        t, weight = np.polynomial.legendre.leggauss(n)
        node, weight = t**3, 3 * t**2 * weight
        at = np.zeros((n, n, 3))
        at[..., 0], at[..., 1], at[..., 2] = x * node[:, None], y * node, z
        field = charge_field(model, at, tolerance=1e-18)[..., 2]
        return x * y * (weight @ field @ weight)

    wanted = (through(1.4) - through(depth)) / 0.6 / 120.0
    assert a.sum() == pytest.approx(wanted, rel=1e-5)
    assert a.sum() < 0


def test_areas_of_a_whole_sensor_sum_to_zero():
    # Thousands of edges add up what is left of the series: 1e-18 of it is below 1e-8.
    sums = [
        area_changes(MODEL, depth=T, reach=reach, tolerance=1e-18).sum()
        for reach in (0, 4, 40)
    ]
    assert 0.1 < sums[1] / sums[0] < 0.2  # nine pixels regain most of the source's loss
    assert 0 < sums[2] / sums[0] < 5e-6  # exp(-pi rho / T) of it is missing at 405 um


def test_columns_lose_what_passes_their_rim():
    """The areas of whole columns add up to the flux through two planes, known in modes.

    Summed over y the charge is a line along y:
    int E_x dy = -(1 / eps T) sum_n sin(k z_q) sin(k z) sinh(k a) / (k a) exp(-k x), k = n pi / T.
    """
    model = dataclasses.replace(MODEL, drift_field=0.6)
    # 40 rows either way: exp(-15) of the flux leaves through their ends.
    a = area_changes(model, depth=T, reach=40, tolerance=1e-18)
    n = np.arange(1, 3000)
    k = n * np.pi / T
    path = (np.cos(k * 3.2) - np.where(n % 2, -1.0, 1.0)) / k
    for reach in (0, 1, 4, 10):
        x = (reach + 0.5) * 10.0
        wide = (np.exp(-k * (x - 1.5)) - np.exp(-k * (x + 1.5))) / (2 * k * 1.5)
        flux = -(np.sin(k * 0.5) * wide * path).sum() / (EPSILON * T) / 0.6
        found = a[:, 40 - reach : 41 + reach].sum()
        assert found == pytest.approx(2 * flux / 120.0, rel=2e-6)


def test_mirrored_pixels_are_equal_bit_for_bit():
    shifts = edge_shifts(MODEL, depth=[10.0, T], reach=3)
    a = shifts.area_changes
    assert a.shape == (2, 7, 7)
    np.testing.assert_array_equal(a, a[:, ::-1])
    np.testing.assert_array_equal(a, a[:, :, ::-1])
    np.testing.assert_array_equal(shifts.north[:, :-1], -shifts.south[:, 1:])
    np.testing.assert_array_equal(shifts.east[..., :-1], -shifts.west[..., 1:])
    lines = displace_boundaries(MODEL, [T], charge=5e4, reach=2)
    np.testing.assert_array_equal(lines.columns[..., 0], -lines.columns[:, ::-1, :, 0])
    np.testing.assert_array_equal(lines.rows[..., 1], lines.rows[:, :, ::-1, 1])


def test_exchanged_axes_exchange_the_lags():
    turned = ImageCharge(
        0.5, 3.2, 1.4, 3.0, 1.5, pitch_x=12.0, pitch_y=10.0, drift_field=MODEL.drift_field
    )
    there, here = (edge_shifts(m, depth=T, reach=3) for m in (turned, MODEL))
    # Distances are summed as squares of x and y in the other order.
    np.testing.assert_allclose(there.north, here.east.T, rtol=1e-9)
    np.testing.assert_allclose(there.area_changes, here.area_changes.T, rtol=1e-9)


def test_everything_counts_from_the_lower_plane():
    """Moved up with plane, charge, seals, back and depths, a sensor is the same."""
    up = 1.25
    moved = dataclasses.replace(
        MODEL,
        **{
            name: getattr(MODEL, name) + up
            for name in ("charge_height", "row_height", "column_height", "thickness")
        },
        plane_height=up,
        drift_field=tuple((z + up, field) for z, field in MODEL.drift_field),
    )
    at = points_between(431)
    np.testing.assert_allclose(
        charge_field(moved, at + np.array([0, 0, up])), charge_field(MODEL, at), rtol=1e-8
    )
    depths = np.array([6.0, T])
    np.testing.assert_allclose(
        area_changes(moved, depth=depths + up, reach=3),
        area_changes(MODEL, depth=depths, reach=3),
        rtol=1e-8,
    )
    how = {"charge": 1e4, "reach": 1, "samples": 4}
    np.testing.assert_allclose(
        trace_boundaries(moved, depths + up, **how).rows,
        trace_boundaries(MODEL, depths, **how).rows,
        rtol=1e-10,
    )
    other = dataclasses.replace(MODEL, plane_height=-0.3)
    assert area_changes(other, depth=T, reach=0) < area_changes(MODEL, depth=T, reach=0)


def test_drift_fields_scale_shifts():
    uniform = dataclasses.replace(MODEL, drift_field=0.5)
    double = dataclasses.replace(MODEL, drift_field=((0, 1.0), (30, 1.0), (T, 1.0)))
    a, b = (area_changes(m, depth=T, reach=2) for m in (uniform, double))
    np.testing.assert_allclose(a, 2 * b, rtol=1e-8)  # panels end elsewhere


def test_depths_in_any_order_and_shape():
    depths = np.array([[40.0, 5.0], [T, 5.0]])
    a = area_changes(MODEL, depth=depths, reach=1)
    assert a.shape == (2, 2, 3, 3)
    for where, depth in np.ndenumerate(depths):
        alone = area_changes(MODEL, depth=depth, reach=1)
        np.testing.assert_allclose(a[where], alone, rtol=1e-7)  # panels end elsewhere
    np.testing.assert_array_equal(a[0, 1], a[1, 1])


def test_traced_rays_agree_in_first_order():
    """The difference to straight paths goes as the charge squared."""
    differences = []
    for charge in (1e3, 1e4):
        first, traced = (
            make(MODEL, [5.0, T], charge=charge, reach=2, samples=8)
            for make in (displace_boundaries, trace_boundaries)
        )
        rows = traced.rows[..., 1] - first.rows[..., 1]
        columns = traced.columns[..., 0] - first.columns[..., 0]
        differences.append(max(np.abs(rows).max(), np.abs(columns).max()))
        moved = np.abs(first.rows[:, 3, :, 1] - 6.0).max()
        # In units of the shift, twice the field of the charge over the drift field.
        assert differences[-1] < 0.05 * moved * charge / 1e4
    # Third order: 0.1 of the second at 1e5 e-, 0.01 at 1e4.
    assert differences[1] / differences[0] == pytest.approx(100, rel=0.03)


def test_rays_follow_the_whole_field():
    """Field lines of charge and drift field together by an adaptive integrator."""
    charge = 1e5
    traced = trace_boundaries(MODEL, [5.0, T], charge=charge, reach=1, samples=4)

    def slope(z, at):
        field = charge * charge_field(MODEL, [*at, min(z, T)])
        return field[:2] / (MODEL.drift_at(z) + field[2])

    still = displace_boundaries(MODEL, [T], charge=0.0, reach=1, samples=4)
    for moved, nominal, seal in (
        (traced.rows, still.rows, 1.4),
        (traced.columns, still.columns, 3.2),
    ):
        for point in (8, 9, 10):  # of the source's edge: the middle, the corner, past it
            path = solve_ivp(
                slope, (seal, T), nominal[0, 2, point], method="DOP853", rtol=1e-9, atol=1e-10,
                t_eval=[5.0, T],
            ).y  # fmt: skip
            # Six steps of fourth order a panel: below 1e-6 um, of shifts of up to 0.7 um.
            np.testing.assert_allclose(moved[:, 2, point], path.T, atol=2e-6)


def test_the_far_field_of_the_poisson_engine_has_the_same_shape():
    """A dipole on the plane, here a charge just above it, shifts boundaries by distance and depth."""
    z = np.linspace(0.0, T, 2001)
    half_cell = np.array([0.0, 1.0])
    mesh = SimpleNamespace(x=half_cell, y=half_cell, z=z)
    unit = SimpleNamespace(mesh=mesh, phi=(-0.5 * z)[:, None, None] * np.ones((1, 2, 2)))
    depths = np.array([20.0, 60.0, T])
    far = FarField.of(unit, depths, 0.0, 200.0)
    model = ImageCharge(0.01, 4.0, 4.0, 0.05, 0.05, drift_field=0.5)
    rho = np.array([25.0, 40.0, 60.0, 100.0])
    at = np.column_stack([rho, np.zeros(4)])
    ours = -engine._shifts(model, at, 0, depths, 1e-20)
    theirs = np.array([far.vectors(at, d)[:, 0] for d in range(3)])
    # Theirs: 200 steps by trapezoids, 40 modes, interpolated between 200 distances.
    ratio = theirs / ours
    np.testing.assert_allclose(ratio / ratio[-1, -1], 1.0, atol=0.01)


def test_vertices_keep_the_areas():
    """Through the lines and the resampling of the Poisson engine to polygons."""
    charge = 100.0
    lines = displace_boundaries(MODEL, [6.0, T], charge=charge, reach=2)
    corners, horizontal, _ = lines.vertices(16, vertex_fractions(16))
    north = edge_shifts(MODEL, depth=[6.0, T], reach=2).north
    at = np.concatenate([[0.0], vertex_fractions(16), [1.0]])
    for d in range(2):
        for i in range(5):
            side = np.concatenate(
                [
                    corners[d, 3, i : i + 1, 1],
                    horizontal[d, 3, i, :, 1],
                    corners[d, 3, i + 1 : i + 2, 1],
                ]
            )
            mean = trapezoid(side, at) / (12.0 * charge)
            # Lines of 48 points a pixel, linear in between; second order in 100 e-.
            assert mean == pytest.approx(north[d, 2, i], rel=2e-3)


# -- refusals ---------------------------------------------------------------------------


def test_wrong_questions_are_refused():
    for call, message in (
        (
            lambda: area_changes(MODEL, depth=0.0),
            "conversion depth 0 um must be above 0 um, the gates, and at most 100 um, the back "
            "surface",
        ),
        (
            lambda: area_changes(MODEL, depth=5.0, reach=-1),
            "reach = -1 must be a whole number of pixels from 0",
        ),
        (
            lambda: displace_boundaries(MODEL, [5.0, 5.0], charge=1.0),
            "conversion depths [5.0, 5.0] um must ascend",
        ),
        (
            lambda: trace_boundaries(MODEL, [5.0], charge=1e7, reach=1, samples=4),
            "charge = 1e+07 e- turns the drift field round at z = 3.35 um: no electron passes",
        ),
    ):
        with pytest.raises(TableError) as caught:
            call()
        assert str(caught.value) == message
