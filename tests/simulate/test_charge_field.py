"""The field of a charged rectangle against closed forms that share nothing with its images."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import k0, k1

from bfsensor.errors import DeviceError, TableError
from bfsensor.simulate import charge_field as fields
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.units import VACUUM_PERMITTIVITY
from tests.simulate.cases import charge_field

MODEL = ImageCharge(
    0.5, 1.4, 3.2, 1.5, 3.0, pitch_x=10.0, pitch_y=12.0, drift_field=((0, 0.75), (100, 0.37))
)  # fmt: skip
# A charge half way up, where both planes count.
HIGH = ImageCharge(40.0, 42.0, 45.0, 2.0, 3.0)
POINT = ImageCharge(2.0, 4.0, 4.0, 0.05, 0.05)
EPSILON = MODEL.permittivity * VACUUM_PERMITTIVITY
T = 100.0


def points_between(seed, count=40, lateral=40.0, low=0.0, high=T):
    rng = np.random.default_rng(seed)
    at = rng.uniform(-lateral, lateral, (count, 3))
    at[:, 2] = rng.uniform(low, high, count)
    return at


@pytest.mark.parametrize("model", [MODEL, HIGH])
@pytest.mark.parametrize("plane", [0.0, T])
def test_planes_are_conductors(model, plane):
    at = points_between(911)
    at[:, 2] = plane
    field = charge_field(model, at)
    assert np.abs(field[:, :2]).max() < fields.TOLERANCE
    assert np.abs(field[:, 2]).min() > 10 * fields.TOLERANCE  # the charge is felt there


@pytest.mark.parametrize("model", [MODEL, HIGH])
@pytest.mark.parametrize("place", [(7.0, 2.0), (0.0, 9.0), (30.0, -30.0)])
def test_both_planes_are_at_one_potential(model, place):
    """From plane to plane the field along z integrates to zero, beside the charge."""

    def along(z):
        return 1e6 * charge_field(model, [*place, z])[2]

    q = model.charge_height
    parts = [
        quad(along, *ends, epsrel=1e-11, epsabs=0)[0]
        for ends in ((0, q), (q, T / 2), (T / 2, T))
    ]
    # The tolerance of the series over the thickness, and that of the quadrature.
    assert abs(sum(parts)) < 1e6 * fields.TOLERANCE * T + 1e-10 * np.abs(parts).max()


def flux(model, low, high, faces=range(6), n=48):
    """Outward flux of the field through faces of a box [V um per electron]."""
    node, weight = np.polynomial.legendre.leggauss(n)
    total = 0.0
    for face in faces:
        axis, side = divmod(face, 2)
        u, v = [k for k in range(3) if k != axis]
        half = 0.5 * (np.array(high) - low)
        middle = 0.5 * (np.array(high) + low)
        at = np.zeros((n, n, 3))
        at[..., axis] = (low, high)[side][axis]
        at[..., u] = middle[u] + half[u] * node[:, None]
        at[..., v] = middle[v] + half[v] * node[None]
        value = charge_field(model, at)[..., axis]
        total += (2 * side - 1) * half[u] * half[v] * (weight @ value @ weight)
    return total


@pytest.mark.parametrize(
    ("low", "high", "inside"),
    [
        ((-6, -8, 38), (7, 9, 43), 1),
        ((-20, -15, 33), (25, 30, 60), 1),
        ((-6, -8, 43), (7, 9, 60), 0),
        ((6, 2, 30), (15, 20, 50), 0),
    ],
)
def test_gauss_law(low, high, inside):
    # 48 points a side, 2 um and more from the charge: 1e-8 of its flux.
    assert flux(HIGH, low, high) * EPSILON == pytest.approx(-inside, abs=1e-7)


def test_no_flux_beyond_the_planes():
    """All of the flux of a charge low down ends on the planes: on the far one z_q / T of it."""
    node, weight = np.polynomial.legendre.leggauss(200)
    side = 600.0  # six thicknesses; beyond it exp(-6 pi), 1e-8, is left
    at = np.zeros((200, 200, 3))
    at[..., 0], at[..., 1], at[..., 2] = side * node[:, None], side * node, T
    field = charge_field(MODEL, at, tolerance=1e-18)[..., 2]
    through = side**2 * (weight @ field @ weight)
    assert -through * EPSILON == pytest.approx(MODEL.charge_height / T, rel=1e-6)


def mode_sum(model, rho, z):
    """Field (E_rho, E_z) of one electron as a point, by modes between the planes.

    phi = -(1 / pi eps T) sum_n sin(n pi z / T) sin(n pi z_q / T) K_0(n pi rho / T).
    """
    n = np.arange(1, 2000)
    k = n * np.pi / T
    use = k * rho < 600
    k = k[use]
    scale = -1 / (np.pi * EPSILON * T) * np.sin(k * model.charge_height)
    return (
        (scale * k * np.sin(k * z) * k1(k * rho)).sum(),
        -(scale * k * np.cos(k * z) * k0(k * rho)).sum(),
    )


@pytest.mark.parametrize("rho", [3.0, 10.0, 45.0, 120.0])
@pytest.mark.parametrize("z", [2.5, 20.0, 70.0, 99.0])
@pytest.mark.parametrize("height", [2.0, 55.0])
def test_a_small_rectangle_is_the_mode_sum_of_a_point(rho, z, height):
    model = dataclasses.replace(
        POINT, charge_height=height, row_height=60, column_height=60
    )
    angle = 0.7
    field = charge_field(model, [rho * np.cos(angle), rho * np.sin(angle), z])
    across = field[0] * np.cos(angle) + field[1] * np.sin(angle)
    # The mean over a square is phi + a^2 / 6 (d^2/dx^2 + d^2/dy^2) phi: a few times the square
    # of half side over distance.
    wanted = np.array(mode_sum(model, rho, z))
    distance = np.hypot(rho, z - height)
    limit = 4 * (0.05 / distance) ** 2 * np.hypot(*wanted) + fields.TOLERANCE
    np.testing.assert_allclose([across, field[2]], wanted, rtol=0, atol=limit)


def lattice_sum(model, x, y, z, period=500.0, modes=420):
    """Field of rectangles repeated in x and y, by Fourier's series of their charge density.

    A mode k varies in height as sinh(k z) below the charge and sinh(k (T - z)) above.
    """
    k = 2 * np.pi * np.arange(-modes, modes + 1) / period
    kx, ky = k[None, :], k[:, None]
    kr = np.hypot(kx, ky)
    kr[modes, modes] = 1e-9  # the mean: linear in height
    density = -np.sinc(kx * model.half_width_x / np.pi) * np.sinc(
        ky * model.half_width_y / np.pi
    )
    q = model.charge_height
    low, high = min(z, q), max(z, q)
    # sinh(k low) sinh(k (T - high)) / (k sinh(k T)), without overflow.
    rise, fall = -np.expm1(-2 * kr * low), -np.expm1(-2 * kr * (T - high))
    scale = np.exp(-kr * (high - low)) / (2 * kr * -np.expm1(-2 * kr * T))
    height = scale * rise * fall
    slope = scale * kr * (-rise * (2 - fall) if z > q else fall * (2 - rise))
    wave = density * np.exp(1j * (kx * x + ky * y)) / (EPSILON * period**2)
    return (
        -(1j * kx * wave * height).sum().real,
        -(1j * ky * wave * height).sum().real,
        -(wave * slope).sum().real,
    )


@pytest.mark.parametrize(
    "place", [(5.0, 0.0, 6.0), (1.0, 4.0, 8.0), (15.0, 25.0, 50.0), (0.0, 0.0, 100.0)]
)
def test_the_rectangle_is_its_fourier_series(place):
    # Waves up to 5.3 /um are dropped beyond, exp(-5.3 * 5.5), 1e-13 of the field of a sheet;
    # the next rectangles are five thicknesses away, exp(-5 pi), 2e-7 of their field near by.
    found = charge_field(MODEL, place, tolerance=1e-18)
    size = np.linalg.norm(found)
    np.testing.assert_allclose(found, lattice_sum(MODEL, *place), rtol=0, atol=1e-5 * size)


@pytest.mark.parametrize("model", [MODEL, HIGH])
def test_the_series_keeps_its_tolerance(model):
    """Against so many pairs that nothing is left, at the farthest points allowed."""
    at = points_between(3127, lateral=60.0)
    distance = fields.farthest(at[:, :2], model)
    exact = fields.sum_field(model, at, fields.image_series(model, distance, 1e-24))
    counts = []
    for tolerance in (1e-10, 1e-12, 1e-14, 1e-17):
        series = fields.image_series(model, distance, tolerance)
        counts.append(len(series.heights))
        error = np.abs(fields.sum_field(model, at, series) - exact).max()
        # Round-off of 1e2 images of 1e-4 V/um / um^2 at 1e-16 over 4 a b.
        assert error < tolerance + 1e-19
        if tolerance < 1e-10:
            # Not wasteful: the bound is a worst case, but two pairs less miss it by far.
            fewer = fields._sum_images(model, max(len(series.heights) // 4 - 4, 0))
            assert (
                np.abs(fields.sum_field(model, at, fewer) - exact).max() > 0.1 * tolerance
            )
    assert counts == sorted(set(counts))


def test_without_its_tail_the_series_converges_slowly():
    """The two terms of the tail reduce the error by three orders at four pairs."""
    at = points_between(3127, lateral=60.0)
    series = fields.image_series(MODEL, fields.farthest(at[:, :2], MODEL), 1e-14)
    exact = fields.sum_field(MODEL, at, fields.image_series(MODEL, 200.0, 1e-24))
    bare = dataclasses.replace(series, tail=np.zeros(2))
    error = np.abs(fields.sum_field(MODEL, at, series) - exact).max()
    assert np.abs(fields.sum_field(MODEL, at, bare) - exact).max() > 1e3 * error


# -- parameters ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"charge_height": 0.0}, "image charge: charge_height = 0.0 um must be "
         "a finite number above 0 um"),
        ({"half_width_x": np.nan}, "image charge: half_width_x = nan um must be "
         "a finite number above 0 um"),
        ({"pitch_x": "10 um"}, "image charge: pitch_x = '10 um' um must be a finite "
         "number above 0 um"),
        ({"plane_height": np.inf}, "image charge: plane_height = inf um must be a finite number"),
        (
            {"plane_height": 0.5},
            "image charge: charge_height = 0.5 um must be above plane_height = 0.5 um",
        ),
        ({"permittivity": 0.5}, "image charge: permittivity = 0.5 must be at least 1"),
        (
            {"row_height": 0.4},
            "image charge: row_height = 0.4 um must be above charge_height = 0.5 um and below "
            "thickness = 100 um",
        ),
        (
            {"column_height": 100.0},
            "image charge: column_height = 100 um must be above charge_height = 0.5 um and "
            "below thickness = 100 um",
        ),
        (
            {"half_width_y": 6.5},
            "image charge: half_width_y = 6.5 um must be at most half of pitch_y, 6 um",
        ),
        (
            {"drift_field": -0.5},
            "image charge: drift_field = -0.5 V/um must be finite and above 0 V/um everywhere",
        ),
        (
            {"drift_field": "strong"},
            "image charge: drift_field = 'strong' must be a number or pairs (height, field)",
        ),
        (
            {"drift_field": ((2.0, 0.5), (100.0, 0.5))},
            "image charge: heights of drift_field, [2.0, 100.0] um, must ascend from at most "
            "1.4 um to at least thickness = 100 um",
        ),
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(changes, message):
    with pytest.raises(DeviceError) as caught:
        dataclasses.replace(MODEL, **changes)
    assert str(caught.value) == message


def test_a_series_without_tolerance_is_refused():
    with pytest.raises(TableError, match=r"tolerance = 0\.0 V/um must be above 0 V/um"):
        fields.image_series(MODEL, T, 0.0)


def test_parameters_are_values():
    again = pickle.loads(pickle.dumps(MODEL))
    assert again == MODEL
    assert hash(again) == hash(MODEL)
    assert dataclasses.replace(MODEL, drift_field=[[0, 0.75], [100, 0.37]]) == MODEL
    with pytest.raises(dataclasses.FrozenInstanceError):
        MODEL.thickness = 50.0
