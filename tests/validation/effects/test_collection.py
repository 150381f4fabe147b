"""Effects of collection against what shares no code with them: series, walks, piles, another engine."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bfsensor.device import silicon
from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.exposure_info import numbers_of
from bfsensor.diagnose.model.flat_predictions import periodic_covariances
from bfsensor.effects.bf_long_range import shifts_of_tail
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.effect import Law, Layout, Shot
from bfsensor.effects.lateral_diffusion import diffusion_variance
from bfsensor.effects.library import LIBRARY, make_effect
from bfsensor.effects.saturation import Saturation, spilled
from bfsensor.errors import EffectError
from bfsensor.response.edge_response import area_matrix
from bfsensor.units import to_kelvin
from validation.common.virtual_source import virtual_baseline
from validation.concealed.card import NOMINAL, SPREAD, shifts_at
from validation.concealed.electrostatics import EdgeShifts
from validation.concealed.library import make_effect as make_theirs
from validation.concealed.plan import Exposure, Geometry

WORDS = (
    "bf_anisotropy", "bf_chromatic", "bf_long_range", "bf_nonlinear", "charge_loss",
    "interpixel_coupling", "lateral_diffusion", "psf_wings", "saturation", "voltage_dependence",
)  # fmt: skip
SHOT = Shot("spot", 0, 10.0, 950.0, -40.0, 193.15)


def a_layout() -> Layout:
    return Layout((256, 256), (), **virtual_baseline().card)


def nominal_shifts() -> tuple[np.ndarray, np.ndarray]:
    found = shifts_at(NOMINAL, 620, -60)
    return np.asarray(found.kx), np.asarray(found.ky)


def neutral(word: str):
    kind = next(k for k in LIBRARY if k.word == word)
    values = {p.name: p.neutral if p.amplitude else p.low for p in kind.parameters}
    return kind(values)


# -- what neutral values do, and what is told of each effect


@pytest.mark.parametrize("word", WORDS)
def test_neutral_changes_no_bit(word):
    effect, layout = neutral(word), a_layout()
    assert effect.is_neutral()
    kx, ky = nominal_shifts()
    moved = effect.edges(kx, ky, SHOT, layout)
    assert np.array_equal(moved[0], kx) and np.array_equal(moved[1], ky)
    assert effect.law() == Law()
    assert effect.spot_light(SHOT, layout) == (0.0, ())
    rng = np.random.default_rng(8)
    c = rng.normal(0, 300, (2, 16, 16)) + 1e5 * (np.arange(16) == 0)
    axes = {"level": np.array([1e5, 1.4e5]), "light": np.array([1e5, 1.5e5])}
    assert np.array_equal(effect.covariances(c, axes, layout), c)
    assert not effect.flat_mean(axes, layout).any()
    charge = rng.normal(1e5, 300, (8, 8)).astype(np.float32)
    assert np.array_equal(effect.store(charge, SHOT, layout, rng, {}), charge)


@pytest.mark.parametrize("word", WORDS)
def test_starts_lie_in_the_range_and_name_all_parameters(word):
    kind = next(k for k in LIBRARY if k.word == word)
    for values in kind.starts(a_layout()):
        effect = kind(values)
        assert not effect.is_neutral()
        assert pickle.loads(pickle.dumps(effect)) == effect
    assert kind.source and kind.touches


# -- the same conventions as the sensor of the concealed campaigns, at drawn conditions


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("bf_chromatic", {"kappa": -0.13}),
        ("bf_anisotropy", {"eps": 0.21}),
        ("voltage_dependence", {"delta": 0.17}),
        ("bf_long_range", {"amp": 4e-8, "power": 2.2}),
    ],
)
def test_edges_are_those_of_the_other_engine(word, values):
    rng = np.random.default_rng(len(word))
    for _ in range(3):
        wavelength, bias = rng.uniform(450, 1000), rng.uniform(-70, -30)
        exposure = Exposure("FLAT", 0, 0.0, 1.0, wavelength, bias)
        context = SimpleNamespace(exposure=exposure, geometry=Geometry(256))
        kx, ky = nominal_shifts()
        theirs = make_theirs(word, values).shifts(EdgeShifts(kx, ky), context)
        shot = Shot("flat", 0, 1.0, wavelength, bias, 173.15)
        ours = make_effect(word, values).edges(kx, ky, shot, a_layout())
        for mine, other in zip(ours, theirs, strict=True):
            # Round-off of two ways to a lattice potential.
            np.testing.assert_allclose(mine, other, atol=1e-6 * np.abs(other).max())
        assert np.abs(ours[0] - np.pad(kx, (len(ours[0]) - len(kx)) // 2)).max() > 1e-10


@pytest.mark.parametrize(("wavelength", "bias", "temperature"), [
    (620.0, -60.0, -100.0), (950.0, -60.0, -100.0), (480.0, -40.0, -80.0), (720.0, -50.0, -90.0),
])  # fmt: skip
def test_diffusion_is_that_of_the_other_engine(wavelength, bias, temperature):
    exposure = Exposure("SPOT", 0, 0.0, 1.0, wavelength, bias, temperature)
    context = SimpleNamespace(exposure=exposure, device=dict(NOMINAL))
    theirs = make_theirs("lateral_diffusion", {"var": 0.05}).spot_light(context)["variance"]
    shot = Shot("spot", 0, 1.0, wavelength, bias, to_kelvin(temperature))
    ours = make_effect("lateral_diffusion", {"var": 0.05}).spot_light(shot, a_layout())[0]
    assert ours == pytest.approx(theirs, rel=1e-6)


# -- diffusion


def test_diffusion_is_the_spread_of_a_random_walk():
    """Electrons that drift from where light converts, kicked in each of 40 pieces of their path."""
    layout = a_layout()
    shot = Shot("spot", 0, 1.0, 950.0, -40.0, 193.15)
    rng = np.random.default_rng(417)
    count, pieces = 40_000, 40
    thickness, length = layout.thickness, layout.absorption[950.0]
    # Inverse of the cumulative distribution of depths that end at the gates.
    depth = -length * np.log1p(rng.random(count) * np.expm1(-thickness / length))
    heat = 8.617333e-5 * shot.temperature
    field = (layout.front - shot.back_bias) / thickness
    x = np.zeros(count)
    for _ in range(pieces):
        # Time of a piece times the mobility; D = mobility kT / q.
        time = (thickness - depth) / pieces / field
        x += np.sqrt(2 * heat * time) * rng.standard_normal(count)
    found = np.var(x) / layout.pixel**2
    # The kurtosis of the mixture is below 4: three standard deviations of a variance.
    assert diffusion_variance(shot, layout) == pytest.approx(found, rel=3 * 2 / count**0.5)


def test_diffusion_without_absorption_takes_that_of_silicon():
    layout = Layout((64, 64), ())
    length = float(silicon.absorption_length(950.0, 173.0))
    known = replace(layout, absorption={900.0: length, 1000.0: length})
    found = diffusion_variance(SHOT, layout)
    assert found == pytest.approx(diffusion_variance(SHOT, known), rel=1e-12)
    assert found != pytest.approx(
        diffusion_variance(SHOT._replace(wavelength=620.0), layout)
    )


# -- flats in closed form


def _moments(a, level, law, side):
    """Covariances of a flat on a small torus, all pairs of pixels, integrated step by step."""
    n = side * side
    half = len(a) // 2
    response = np.zeros((side, side, side, side))
    for y in range(side):
        for x in range(side):
            for dy in range(-half, half + 1):
                for dx in range(-half, half + 1):
                    target = (y + dy) % side, (x + dx) % side
                    response[(*target, y, x)] += a[half + dy, half + dx]
    matrix = response.reshape(n, n)

    def slope(m, c):
        c = c.reshape(n, n)
        turned = (matrix * (1 + law.bend * m) - law.loss * np.eye(n)) @ c
        return (np.eye(n) + turned + turned.T).ravel()

    end = solve_ivp(
        slope, (0, level), np.zeros(n * n), rtol=1e-9, atol=1e-6, method="DOP853"
    )
    return end.y[:, -1].reshape(n, n)[0].reshape(side, side)


@pytest.mark.parametrize("law", [
    Law(), Law(bend=3e-6), Law(bend=-2e-6), Law(loss=3e-7), Law(bend=3e-6, loss=3e-7),
])  # fmt: skip
def test_flats_with_bend_and_loss_solve_their_equation(law):
    a = 1e-6 * np.array([[0.05, 0.3, 0.05], [0.12, -1.04, 0.12], [0.05, 0.3, 0.05]])
    level, side = 1e5, 9
    found = periodic_covariances(a, [level], law=law)[0][:3, :3]
    exact = _moments(a, level, law, side)[:3, :3]
    # Around the small torus comes the eighth power of a m = 0.03 and less.
    np.testing.assert_allclose(found, exact, atol=1e-7 * level)
    plain = periodic_covariances(a, [level])[0][:3, :3]
    assert law == Law() or np.abs(found - plain).max() > 10.0


def test_wide_areas_are_not_folded():
    kx, ky = make_effect("bf_long_range", {"amp": 1e-7, "power": 1.7}).edges(
        *nominal_shifts(), SHOT, a_layout()
    )
    a = area_matrix(kx, ky)
    level = 1e5
    found = periodic_covariances(a, [level])[0]
    twice = periodic_covariances(np.pad(a, 34), [level])[0]
    # Second orders of far lags alone meet around the array: 1e-8 of the level.
    assert np.abs(found[:5, :5] - twice[:5, :5]).max() < 1e-6 * level
    # First order: the areas themselves; the second is a m = 0.006 of those next to the charge.
    weak = periodic_covariances(a, [1e3])[0][3, 4]
    assert weak / 1e3**2 == pytest.approx(a[33, 34], rel=0.01)


@pytest.mark.parametrize("power", [1.7, 2.5])
def test_tail_conserves_charge_has_its_areas_and_no_curl(power):
    kx, ky = shifts_of_tail(power, 20)
    a = area_matrix(kx, ky)[1:-1, 1:-1]
    y, x = np.indices(a.shape) - 19
    r = np.hypot(x, y)
    near = (r > 0) & (r < 19)
    np.testing.assert_allclose(a[near], r[near] ** -power, atol=1e-9)
    lag = np.arange(-20, 21)
    whole = np.hypot(lag, lag[:, None])
    assert a[19, 19] == pytest.approx(-np.sum(whole[whole > 0] ** -power), rel=1e-9)
    # Around each corner the shifts add up to nothing.
    curl = np.diff(kx, axis=0)[:, :-1] - np.diff(ky, axis=1)[:-1]
    assert np.abs(curl).max() < 1e-12 * np.abs(kx).max() * kx.size
    # Charge repels: edges to the right of it move towards it.
    assert kx[20, 20] < 0 < kx[20, 19]


# -- full well


def _toppled(column: np.ndarray, full_well: float) -> np.ndarray:
    """End of endless sharing, in one go.

    What topples through each pixel makes, with the charge's double sum, the least concave curve
    above that sum; charge leaves at both ends.
    """
    n = len(column)
    g = np.zeros(n + 2)
    g[1:] = np.cumsum(np.concatenate([[0.0], np.cumsum(2 * (column - full_well))]))
    g -= np.linspace(0, g[-1], n + 2)
    hull = [0]
    for k in range(1, n + 2):
        while len(hull) > 1 and (g[hull[-1]] - g[hull[-2]]) * (k - hull[-1]) <= (
            g[k] - g[hull[-1]]
        ) * (hull[-1] - hull[-2]):
            hull.pop()
        hull.append(k)
    moved = np.interp(np.arange(n + 2), hull, g[hull]) - g
    return column + 0.5 * np.diff(moved, 2)


def test_spilled_charge_is_where_endless_sharing_leaves_it():
    rng = np.random.default_rng(90)
    columns = rng.normal(0.0, 1.0, (200, 6))
    # Room at the ends: nothing leaves.
    columns[:8] = columns[-8:] = -3.0
    found = spilled(columns, 1.5)
    exact = np.array([_toppled(c, 1.5) for c in columns.T]).T
    np.testing.assert_allclose(found, exact, atol=1e-6)
    assert found.sum() == pytest.approx(columns.sum(), abs=1e-6)
    assert np.abs(found - np.minimum(columns, 1.5)).max() > 0.1


@pytest.mark.parametrize("distance", [1.2, 2.0, 3.0])
def test_flats_near_the_full_well_lose_what_a_pile_loses(distance):
    """Pairs of uneven flats, spilled by the pile's closed form."""
    level, full_well = 9e4, 9e4 + 300.0 * distance
    effect = Saturation({"full_well": full_well})
    c = np.zeros((1, 16, 16))
    c[0, 0, 0] = 300.0**2
    axes = {"level": np.array([level]), "light": np.array([level])}
    found = effect.covariances(c, axes, a_layout())[0] / 300.0**2
    rng = np.random.default_rng(63)
    pattern = 3e-3 * level / 300.0 * rng.standard_normal((300, 256))
    pairs = [rng.standard_normal(pattern.shape) + pattern for _ in range(2)]
    left = np.diff([[_toppled(c, distance) for c in one] for one in pairs], axis=0)[0]
    exact = [np.mean(left[:, k:] * left[:, : 256 - k]) / 2 for k in range(3)]
    # Of 25,000 and 77,000 pixels: 1.4 / sqrt(n) each, four times; distances go by tenths.
    assert found[0, 0] == pytest.approx(exact[0], abs=0.045)
    np.testing.assert_allclose(found[1:3, 0], exact[1:], atol=0.03)
    assert found[0, 0] < 0.99


def test_flats_far_beyond_the_full_well_are_flat():
    effect = Saturation({"full_well": 9e4})
    c = np.full((2, 8, 8), 5e4)
    axes = {"level": np.array([9e4, 6e4]), "light": np.array([1.1e5, 6e4])}
    found = effect.covariances(c, axes, a_layout())
    assert not found[0].any() and np.array_equal(found[1], c[1])
    np.testing.assert_allclose(effect.flat_mean(axes, a_layout()), [-2e4, 0.0])


def test_saturation_starts_at_the_level_that_flats_do_not_pass():
    levels = np.minimum(2000.0 * np.arange(5.0, 65, 5), 8.7e4)
    shots = tuple(
        Shot("flat", n, 5.0 * (n + 1), 620.0, -60.0, 173.15, 0.0, level)
        for n, level in enumerate(levels)
    )
    starts = Saturation.starts(Layout((64, 64), (), shots))
    places = [s["full_well"] for s in starts]
    # As far off as the gain may be.
    assert 8.7e4 in places and len(places) == 3
    np.testing.assert_allclose(places, 8.7e4, rtol=0.08)


# -- device parameters


def _kinds():
    b = virtual_baseline()
    return {
        k.variant: k
        for k in device_parameters(b.derivatives_by_condition(), b.spread, b.nominal)
    }


def test_device_parameters_move_edges_as_the_baseline_does():
    baseline, layout = virtual_baseline(), a_layout()
    assert set(_kinds()) == set(SPREAD)
    for name, kind in _kinds().items():
        change = 7 * SPREAD[name]
        effect = kind({name: NOMINAL[name] + change})
        assert pickle.loads(pickle.dumps(effect)) == effect
        for wavelength, back_bias in ((950.0, -60.0), (620.0, -40.0)):
            condition = Condition(
                wavelength=wavelength, back_bias=back_bias, temperature=173.15
            )
            plain, _ = baseline.at(condition)
            moved, _ = baseline.at(condition, {name: change})
            shot = Shot("flat", 0, 1.0, *numbers_of(condition))
            for ours, wanted in zip(effect.edges(*plain, shot, layout), moved, strict=True):
                np.testing.assert_allclose(ours, wanted, rtol=1e-9, atol=1e-18)
        assert np.array_equal(
            kind({name: NOMINAL[name]}).edges(*plain, shot, layout)[0], plain[0]
        )


@pytest.mark.parametrize(
    # Measured at 5 and 10 spreads, either sign, the larger; a fifth more is allowed.
    ("name", "five", "ten"),
    [("thickness", 0.017, 0.034), ("h", 0.002, 0.006), ("zx", 0.011, 0.026), ("zy", 0.017, 0.046),
     ("doping", 0.046, 0.092)],
)  # fmt: skip
def test_device_parameters_are_linear_to_what_is_said(name, five, ten):
    baseline, kind = virtual_baseline(), _kinds()[name]
    plain, _ = baseline.at(Condition(wavelength=620.0, back_bias=-60.0, temperature=173.15))
    for spreads, limit in ((5, five), (10, ten)):
        found = []
        for sign in (1, -1):
            value = NOMINAL[name] + sign * spreads * SPREAD[name]
            shot = Shot("flat", 0, 1.0, 620.0, -60.0, 173.15)
            linear = area_matrix(*kind({name: value}).edges(*plain, shot, a_layout()))
            exact = area_matrix(
                *map(np.asarray, shifts_at({**NOMINAL, name: value}, 620, -60))
            )
            change = exact - area_matrix(*plain)
            near = np.s_[6:15, 6:15]
            found.append(
                np.linalg.norm((linear - exact)[near]) / np.linalg.norm(change[near])
            )
        assert limit / 3 < max(found) < 1.2 * limit


def test_device_parameters_without_nominal_value_or_spread():
    k = np.zeros((5, 5))
    pair = {(620.0, -60.0): (k, k)}
    assert not device_parameters({"a10": pair}, {"a10": 1.0}, {})
    with pytest.raises(EffectError, match="spread of h = 0"):
        device_parameters({"h": pair}, {"h": 0.0}, {"h": 1.2})
