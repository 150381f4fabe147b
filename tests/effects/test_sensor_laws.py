"""Laws of light, position and silicon against a few lines of code of their own, at three strengths.

Each prediction is compared with what the law's formula says, pixel by pixel; a law that was switched off
predicts no change and fails.
"""

from collections.abc import Callable

import numpy as np
import pytest

from bfsensor.diagnose.data.map_rings import find_radial
from bfsensor.diagnose.model.effect_chain import EffectChain
from bfsensor.diagnose.model.map_predictions import area_change
from bfsensor.effects import (
    AbsorptionChromatic,
    BrighterFatterAnisotropy,
    BrighterFatterLongRange,
    DivisaderoTearing,
    EdgeRolloff,
    EdgesNonlinear,
    FlatShutter,
    InterpixelCoupling,
    RadialTreeRings,
    ShutterTiming,
    Tearing,
    WavyMask,
)
from bfsensor.effects.effect import Effect, Layout, Segment, Shot
from bfsensor.response.edge_response import area_matrix

NY, NX = 40, 56
HALVES = Segment(0, 0, NX // 2, NY), Segment(NX // 2, 0, NX // 2, NY)
SHOT = Shot("flat", -1, 2.0, 620.0, -60.0, 173.15)
WAVES = ((1 / 17.0, 0.6, 0.2), (1 / 9.0, -0.3, 0.7))
SEEN = ({"map": "all", "shape": "radial", "xc": 21.0, "yc": -7.0, "waves": WAVES},)
LAYOUT = Layout((NY, NX), HALVES, sightings=SEEN)
STRENGTHS = (0.2, 1.0, 3.0)


def radial(amp: float) -> np.ndarray:
    """Flux of the displacement through the four edges of each pixel, edge by edge."""

    def u(x: float, y: float) -> np.ndarray:
        away = np.array([x - 21.0, y + 7.0])
        r = max(np.hypot(*away), 1e-9)
        turn = [2 * np.pi * f * r for f, *_ in WAVES]
        size = sum(
            s * np.sin(t) + c * np.cos(t) for t, (_, s, c) in zip(turn, WAVES, strict=True)
        )
        return amp * size * away / r

    out = np.empty((NY, NX))
    for y in range(NY):
        for x in range(NX):
            out[y, x] = (u(x + 0.5, y) - u(x - 0.5, y))[0] + (
                u(x, y + 0.5) - u(x, y - 0.5)
            )[1]
    return out


def edge_power(amp: float) -> np.ndarray:
    """Power law outside a rim that does not move, between columns only."""

    def u(edge: int) -> float:
        if edge in (0, NX):
            return 0.0
        return amp * ((1 + (NX - edge) / 5.0) ** -2.5 - (1 + edge / 5.0) ** -2.5)

    return np.array([[u(x + 1) - u(x) for x in range(NX)]] * NY)


def divisadero(amp: float) -> np.ndarray:
    """Edges moved away from the middle of column 20, in the upper half of the rows."""

    def u(edge: int) -> float:
        d = edge - 20.5
        return amp * np.sign(d) * np.exp(-abs(d) / 2.5)

    row = np.array([u(x + 1) - u(x) for x in range(NX)])
    part = np.clip((np.arange(NY) + 0.5) / (NY / 2), 0.0, 1.0)
    return part[:, None] * row


def torn_from_the_top(amp: float) -> np.ndarray:
    row = np.array(
        [np.exp(-abs(x + 1 - 30) / 2) - np.exp(-abs(x - 30) / 2) for x in range(NX)]
    )
    part = np.clip((np.arange(NY) + 0.5) / (NY / 2), 0.0, 1.0)
    return amp * part[:, None] * row


def wavy_rows(amp: float) -> np.ndarray:
    u = [amp * np.sin(2 * np.pi * (y / 21.0 + 0.1)) for y in range(NY + 1)]
    return np.repeat(np.diff(u)[:, None], NX, axis=1)


MAPS: dict[str, tuple[Callable[[float], Effect], Callable[[float], np.ndarray]]] = {
    "radial": (
        lambda a: RadialTreeRings(
            {"amp": a, "period": 17.0, "xc": 21.0, "yc": -7.0, "drift": 1.0, "field": 1.0}
        ),
        radial,
    ),
    "edge power": (
        lambda a: EdgeRolloff({"amp": a / 2, "length": 2.0, "sides": 1.0, "tail": 0.4, "rim": 0}),
        edge_power,
    ),
    "divisadero": (
        lambda a: DivisaderoTearing(
            {"amp": a, "length": 2.5, "column": 20.5 / NX, "open": 0.5, "top": 1}
        ),
        divisadero,
    ),
    "from the top": (
        lambda a: Tearing({"amp": a, "length": 2.0, "column": 30 / NX, "open": 0.5, "top": 1}),
        torn_from_the_top,
    ),
    "wavy rows": (
        lambda a: WavyMask({"amp": a, "period": 21.0, "phase": 0.1, "along": 1}),
        wavy_rows,
    ),
}  # fmt: skip


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("law", MAPS)
def test_maps_change_as_the_law_says(law, strength):
    make, said = MAPS[law]
    amp = 0.01 * strength
    true = said(amp)
    found = area_change(make(amp), SHOT, LAYOUT)
    # A cubic between half pixels follows waves of nine pixels to 1e-4 of their amplitude.
    assert np.abs(found - true).max() < 2e-4 * np.abs(true).max()
    off = area_change(make(amp).scaled(0.0), SHOT, LAYOUT)
    assert off is None or not np.abs(off).any()


def test_rings_weaken_with_the_voltage_and_with_a_shorter_drift():
    place = {"amp": 0.01, "period": 17.0, "xc": 21.0, "yc": -7.0}
    effect = RadialTreeRings(place | {"drift": 1.0, "field": 1.0})
    usual = area_change(effect, SHOT, LAYOUT)
    more = area_change(effect, SHOT._replace(back_bias=-100.0), LAYOUT)
    # From 8 V at the front to -60 and -100 V at the back.
    assert more == pytest.approx(usual * 68 / 108)
    red = area_change(effect, SHOT._replace(wavelength=950.0), LAYOUT)
    assert np.abs(red).max() < 0.9 * np.abs(usual).max()
    same = RadialTreeRings(place | {"drift": 0.0, "field": 1.0})
    assert np.array_equal(
        area_change(same, SHOT._replace(wavelength=950.0), LAYOUT),
        area_change(same, SHOT, LAYOUT),
    )


def test_rings_about_a_centre_on_the_sensor_are_found_with_all_their_periods():
    rng = np.random.default_rng(8237)
    y, x = np.mgrid[:128.0, :128.0]
    r = np.hypot(x - 70.3, y - 41.8)
    rings = sum(np.sin(2 * np.pi * r / p + p) for p in (9.0, 15.0, 33.0))
    noise = rng.standard_normal(r.shape)
    found = find_radial(0.3 * rings + noise, x, y, [], least=35.0)
    assert found is not None
    # The profile's gradient over its noise gives the centre to a tenth of a pixel.
    assert (found["xc"], found["yc"]) == pytest.approx((70.3, 41.8), abs=0.5)
    periods = sorted(1 / f for f, *_ in found["waves"])
    assert periods == pytest.approx([9.0, 15.0, 33.0], rel=0.02)
    assert find_radial(noise, x, y, [], least=35.0) is None


@pytest.mark.parametrize("seed", [8239, 8240, 8241])
def test_the_period_of_rings_is_their_mean_spacing(seed):
    """Rings of a changing spacing are many waves, of which single ones are large and cancel."""
    y, x = np.mgrid[:256.0, :256.0]
    r = np.hypot(x + 60.0, y - 300.0)
    phase = r / 24 * (1 + 0.1 * np.sin(2 * np.pi * r / 400))
    rings = np.sin(2 * np.pi * phase)
    noise = np.random.default_rng(seed).standard_normal(r.shape)
    found = find_radial(0.5 * rings + noise, x, y, [(-60.0, 300.0)], least=35.0)
    assert found is not None and len(found["waves"]) > 2
    assert found["period"] == pytest.approx(24.0, rel=0.12)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_shades_of_a_shutter_reach_the_means_of_amplifiers(strength):
    dt, level, seconds = 0.02 * strength, 2e4, 2.0
    shape = {"shade": 0.4, "rise": -0.3, "iris": 0.5}
    axes = {
        "amp": np.array([0, 1]),
        "level": np.full(2, level),
        "time": np.full(2, seconds),
    }
    x, y = (2 * (np.arange(n) + 0.5) / n - 1 for n in (NX, NY))
    image = dt * (1 + 0.4 * x - 0.3 * y[:, None] - 0.25 * (x**2 + y[:, None] ** 2))
    light = 1 + image / seconds
    for kind in (ShutterTiming, FlatShutter):
        effect = kind({"dt": dt} | shape)
        assert effect.light_map(SHOT, LAYOUT) == pytest.approx(light)
        found = effect.flat_mean(axes, LAYOUT)
        for amp, s in enumerate(HALVES):
            mean = light[:, s.x : s.x + s.columns].mean()
            # Of what is measured, the part beyond the light of the commanded time.
            assert found[amp] == pytest.approx(level * (1 - 1 / mean))
    spots = {"flux": np.array([1e5]), "time": np.array([seconds])}
    assert FlatShutter({"dt": dt} | shape).spot_flux(spots, LAYOUT) == 0.0
    assert ShutterTiming({"dt": dt} | shape).spot_flux(spots, LAYOUT)[0] > 0.0
    off = ShutterTiming({"dt": 0.0} | shape)
    assert not off.flat_mean(axes, LAYOUT).any()


def shifts() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8243)
    return rng.normal(0, 1e-6, (5, 5)), rng.normal(0, 1e-6, (5, 5))


@pytest.mark.parametrize("strength", STRENGTHS)
def test_shifts_change_edge_by_edge(strength):
    kx, ky = shifts()
    size, near = 0.1 * strength, 0.8
    uneven = BrighterFatterAnisotropy({"eps": size, "near": near})
    nonlinear = EdgesNonlinear({"b": size * 1e-5, "b_y": -size * 2e-5, "near": near})
    found, bent = uneven.edges(kx, ky, SHOT, LAYOUT), nonlinear.bend_edges(kx, ky)
    for j in range(-2, 3):
        for i in range(-2, 3):
            right = np.exp(-near * (np.sqrt((i + 0.5) ** 2 + j**2) - 0.5))
            upper = np.exp(-near * (np.sqrt(i**2 + (j + 0.5) ** 2) - 0.5))
            at = j + 2, i + 2
            assert found[0][at] == pytest.approx((1 - size / 2 * right) * kx[at])
            assert found[1][at] == pytest.approx((1 + size / 2 * upper) * ky[at])
            assert bent[0][at] == pytest.approx(size * 1e-5 * right * kx[at])
            assert bent[1][at] == pytest.approx(-size * 2e-5 * upper * ky[at])
    assert np.array_equal(uneven.scaled(0.0).edges(kx, ky, SHOT, LAYOUT)[0], kx)
    assert not np.any(nonlinear.scaled(0.0).bend_edges(kx, ky))


def test_a_bend_of_all_edges_alike_is_that_of_the_plain_law_to_first_order():
    kx, ky = shifts()
    chain = EffectChain.__new__(EffectChain)
    chain.effects = (EdgesNonlinear({"b": 1e-6, "b_y": 1e-6, "near": 0.0}),)
    chain.layout = LAYOUT
    from bfsensor.device.condition import Condition

    levels = np.array([3e4, 9e4])
    found = chain.level_change((kx, ky), Condition(173.15, -60.0, 620.0), levels)
    # The mean of a level over a flat's growth, weighted by the level, is 2/3 of the last.
    assert found == pytest.approx(
        area_matrix(kx, ky) * 1e-6 * 2 / 3 * levels[:, None, None]
    )


@pytest.mark.parametrize("strength", STRENGTHS)
def test_tails_fall_as_a_power_times_an_exponential(strength):
    zero = np.zeros((3, 3))
    amp = 1e-8 * strength
    wide = Layout((200, 200), (Segment(0, 0, 200, 200),))
    effect = BrighterFatterLongRange({"amp": amp, "power": 0.5, "near": 0.3})
    a = area_matrix(*effect.edges(zero, zero, SHOT, wide))
    middle = a.shape[0] // 2
    for i, j in ((1, 0), (2, 1), (0, 5), (7, 7)):
        r = np.sqrt(i * i + j * j)
        assert a[middle + j, middle + i] == pytest.approx(
            amp * r**-0.5 * np.exp(-0.3 * (r - 1))
        )
    # Charge is conserved but for the rim of the window, where the tail has fallen to 1e-4.
    assert abs(a.sum()) < 1e-3 * np.abs(a).sum()
    assert effect.scaled(0.0).edges(zero, zero, SHOT, wide)[0] is zero


@pytest.mark.parametrize("strength", STRENGTHS)
def test_coupling_reaches_beyond_four_neighbours(strength):
    ax, ay, decay = 1e-3 * strength, 2e-3 * strength, 0.3
    image = np.zeros((15, 15))
    image[7, 7] = 1.0
    effect = InterpixelCoupling({"ax": ax, "ay": ay, "decay": decay})
    found = effect.store(image, SHOT, LAYOUT, np.random.default_rng(8263), {})
    for i, j in ((1, 0), (0, 1), (1, 1), (2, 0), (1, -2), (0, -3)):
        r = np.sqrt(i * i + j * j)
        share = (ax * i * i + ay * j * j) / r**2 * decay ** (r - 1)
        assert found[7 + j, 7 + i] == pytest.approx(share)
    assert found.sum() == pytest.approx(1.0)
    four = effect.with_values(decay=0.0).store(
        image, SHOT, LAYOUT, np.random.default_rng(8263), {}
    )
    assert np.count_nonzero(four) == 5
    off = effect.scaled(0.0).store(image, SHOT, LAYOUT, np.random.default_rng(8263), {})
    assert np.array_equal(off, image)


def test_a_law_without_its_more_general_parameters_is_the_plain_one():
    plain = EdgeRolloff({"amp": 0.1, "length": 3.0})
    assert dict(plain.values) == {
        "amp": 0.1, "length": 3.0, "sides": 0.0, "tail": 0.0, "rim": 1.0
    }  # fmt: skip
    assert plain.law_name == "exponential"


@pytest.mark.parametrize("power", [-1.0, 0.0, 0.6, 1.0])
def test_shifts_go_with_a_power_of_the_absorption_length(power):
    kx, ky = shifts()
    lengths = {480: 0.8, 620: 2.9, 950: 80.0}
    layout = Layout((NY, NX), HALVES, absorption=lengths)
    effect = AbsorptionChromatic({"kappa": 0.1, "power": power})
    for wavelength, length in lengths.items():
        shot = Shot("flat", -1, 2.0, wavelength, -60.0, 173.15)
        ratios = [long / 2.9 for long in (length, 80.0)]
        here, end = (np.log(r) if power == 0 else r**power - 1 for r in ratios)
        found = effect.edges(kx, ky, shot, layout)
        for shift, old in zip(found, (kx, ky), strict=True):
            assert shift == pytest.approx((1 + 0.1 * here / end) * old, rel=1e-9)
    assert np.array_equal(effect.scaled(0.0).edges(kx, ky, SHOT, layout)[0], kx)
