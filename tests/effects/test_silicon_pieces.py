"""Charge-dependent diffusion and quantum yield against electrons that are thrown one by one."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.detect.candidates import tellable
from bfsensor.diagnose.model.flat_predictions import flat_covariances_of, quadrant
from bfsensor.diagnose.model.spot_predictions import grow_spots
from bfsensor.effects.charge_diffusion import charge_diffusion, landing
from bfsensor.effects.effect import Layout, Shot
from bfsensor.effects.quantum_yield import (
    BLUEST,
    REFERENCE,
    extra_electrons,
    quantum_yield,
)
from bfsensor.effects.simulated_physics import DiffusionWidths
from bfsensor.errors import SensorError
from bfsensor.response.edge_response import area_matrix
from bfsensor.sensor.applied_effects import AppliedEffects

VARIANCE = 0.18  # pixel^2, that of ITL's device at -50 V
BIAS, COLD = -50.0, 173.15
WIDTHS = DiffusionWidths(
    (
        ((350.0, BIAS), VARIANCE), ((620.0, BIAS), VARIANCE),
        ((350.0, -100.0), 0.5 * VARIANCE), ((620.0, -100.0), 0.5 * VARIANCE),
    ),
    COLD,
)  # fmt: skip
LAYOUT = Layout((64, 64), (), reference=(620.0, BIAS, COLD))
SHOT = Shot("flat", 0, 1.0, 620.0, BIAS, COLD)
NOTHING = np.zeros((9, 9)), np.zeros((9, 9))


def widening(growth: float):
    return charge_diffusion(WIDTHS)({"growth": growth})


# -- charge-dependent diffusion


@pytest.mark.parametrize("growth", [10.0, 30.0])
def test_a_charged_pixel_loses_light_of_a_flat_to_its_neighbours(growth):
    """Electrons land with the width of the pixel above which they convert; 5 pixels, periodic."""
    rng = np.random.default_rng(2207)
    side, each, charge = 5, 160_000, 1e5
    electrons = side * side * each
    places = rng.uniform(-0.5, side - 0.5, (2, electrons))
    steps = rng.standard_normal((2, electrons))
    above = np.round(places).astype(int)
    middle = (above == side // 2).all(axis=0)
    counts = []
    for wider in (0.01 * growth / 1e5 * charge, 0.0):
        width = np.sqrt(VARIANCE * np.where(middle, 1 + wider, 1.0))
        x, y = np.round(places + width * steps).astype(int) % side
        counts.append(np.bincount(y * side + x, minlength=side**2).reshape(side, side))
    gained = (counts[0] - counts[1]) / each
    areas = charge * area_matrix(*widening(growth).edges(*NOTHING, SHOT, LAYOUT))
    n = len(areas) // 2
    told = np.roll(areas, (side // 2 - n,) * 2, (0, 1))[:side, :side]
    # The same deviates with both widths: only electrons that change pixels are noise.  The linear
    # law overstates the change of the width by a quarter of c Q.
    noise = np.sqrt(abs(told[2, 2]) / each)
    np.testing.assert_allclose(
        gained, told, atol=4 * noise + 0.01 * growth / 3 * abs(told[2, 2])
    )
    assert gained[2, 2] < -15 * noise
    # What a pixel loses its neighbours gain.
    assert gained.sum() == pytest.approx(0, abs=1e-12)
    assert areas.sum() == pytest.approx(0, abs=1e-12)


def spread_by_pixels(electrons, variance, rng):
    """Electrons of uniform light above each pixel, to where they land, on a periodic array."""
    # An electron of uniform light crosses an edge with probability sigma / sqrt(2 pi), less those that
    # would come from beyond the pixel, as numbers drawn uniformly say.
    out = np.zeros_like(electrons)
    u = (np.arange(400) + 0.5) / 400
    widths = np.sqrt(np.linspace(variance.min(), variance.max(), 9))
    crossing = [ndtr(-u / w).mean() for w in widths]
    part = np.interp(variance, widths**2, crossing)
    for image, dx in _thrown(electrons, part, rng):
        for last, dy in _thrown(image, part, rng):
            out += np.roll(last, (dy, dx), (0, 1))
    return out


def _thrown(electrons, part, rng):
    left = rng.binomial(electrons, part)
    right = rng.binomial(electrons - left, part / (1 - part))
    return (left, -1), (electrons - left - right, 0), (right, 1)


def test_flats_that_fill_up_show_its_covariances():
    """Flats filled in steps, each electron with the width of its pixel's charge at that time."""
    rng = np.random.default_rng(2208)
    level, side, flats, steps, growth = 1e5, 128, 40, 12, 20.0
    found = np.zeros((2, 2))
    for _ in range(flats):
        image = np.zeros((side, side), int)
        for _ in range(steps):
            light = rng.poisson(level / steps, (side, side))
            middle = image + 0.5 * level / steps
            wide = VARIANCE * (1 + 0.01 * growth / 1e5 * middle)
            image = image + spread_by_pixels(light, wide, rng)
        left = image - image.mean()
        found += [[(left * np.roll(left, (-j, -i), (0, 1))).mean() for i in range(2)]
                  for j in range(2)]  # fmt: skip
    found /= flats
    # The response follows the width at the level, on average that of two thirds of it, and in steps to
    # the charge before each: one part in their number is lost.
    wider = 1 + 0.01 * growth * 2 / 3
    widths = DiffusionWidths((((620.0, BIAS), wider * VARIANCE),), COLD)
    effect = charge_diffusion(widths)({"growth": growth / wider})
    a = (1 - 1 / steps) * area_matrix(*effect.edges(*NOTHING, SHOT, LAYOUT))
    told = flat_covariances_of(a, [level], lags=1)[0]
    # Errors of means over independent pixels: level / sqrt(n), sqrt 2 of that for the variance.
    noise = level / np.sqrt(flats) / side * np.array([[np.sqrt(2), 1], [1, 1]])
    assert (abs(found - told) < 4 * noise).all()
    assert found[0, 0] < level - 12 * noise[0, 0]
    assert found[1, 1] > 3 * noise[1, 1]


@pytest.mark.parametrize(("flux", "optics", "place"), [
    (2e5, 0.8, (0.1, -0.2)), (6e5, 1.3, (0.0, 0.3)),
])  # fmt: skip
def test_spots_grow_as_electrons_say(flux, optics, place):
    """Spots built up in steps, with electrons thrown by the charge of their pixel and without."""
    rng = np.random.default_rng(2209)
    growth, steps, side, electrons = 20.0, 24, 21, 2_000_000
    c, each = 0.01 * growth / 1e5, electrons // steps
    on, off = np.zeros((2, side, side))
    for step in range(steps):
        light = np.array(place)[:, None] + optics * rng.standard_normal((2, each))
        deviates = rng.standard_normal((2, each))
        column, row = np.round(light).astype(int) + side // 2
        middle = on * (step + 0.5) / max(step, 1)
        for image, growing in ((on, c), (off, 0.0)):
            width = np.sqrt(VARIANCE * (1 + growing * middle[row, column]))
            x, y = np.round(light + width * deviates).astype(int) + side // 2
            image += flux / electrons * np.bincount(
                y * side + x, minlength=side**2
            ).reshape(side, side)  # fmt: skip
    effect, wide = widening(growth), np.hypot(optics, np.sqrt(VARIANCE))
    grow = {"sigma": (wide, wide), "phases": np.array([place]), "flux": flux}
    told = (
        grow_spots(
            *effect.edges(*NOTHING, SHOT, LAYOUT),
            growth=effect.diffusion_growth(SHOT, LAYOUT), **grow,
        )
        - grow_spots(*NOTHING, **grow)
    )[-1, 0]  # fmt: skip
    r = np.arange(side) - side // 2
    seen, said = (
        ((image.sum(0) + image.sum(1)) @ r**2) / flux for image in (on - off, told)
    )
    # A width that changes in steps at the edges makes spots grow by more than one that changes
    # smoothly, v c Q / 2 of the mean charge Q at the end.
    smooth = VARIANCE * c * (off * off).sum() / flux
    assert said == pytest.approx(smooth, rel=0.06) and seen > 5e-3
    assert seen == pytest.approx(said, rel=0.2)
    noise = np.sqrt(flux / electrons * abs(told).max())
    np.testing.assert_allclose(on - off, told, atol=0.12 * abs(told).max() + 4 * noise)
    # Moved edges alone are not enough: half of the growth is diffusion by the mean charge.
    edges = grow_spots(*effect.edges(*NOTHING, SHOT, LAYOUT), **grow) - grow_spots(
        *NOTHING, **grow
    )
    assert (edges[-1, 0].sum(0) @ r**2) < 0.7 * (told.sum(0) @ r**2)


def test_diffusion_follows_heat_and_field():
    effect, at = widening(3.0), LAYOUT
    usual = effect.diffusion_growth(SHOT, at)
    assert usual == pytest.approx(0.03 / 1e5 * VARIANCE)
    warm = SHOT._replace(temperature=1.1 * COLD)
    assert effect.diffusion_growth(warm, at) == pytest.approx(1.1 * usual)
    # Twice the field: half of the variance, and half of its relative growth.
    strong = SHOT._replace(back_bias=-100.0)
    assert effect.diffusion_growth(strong, at) == pytest.approx(usual / 4)
    k, stronger = (area_matrix(*effect.edges(*NOTHING, s, at)) for s in (SHOT, strong))
    # A pixel that is charged loses v c B_0 B_0' to both sides of both axes.
    lost = [v**2 * landing(v, 9)[0] * (landing(v, 9)[0] - landing(1.0001 * v, 9)[0]) / v
            for v in (VARIANCE, VARIANCE / 2)]  # fmt: skip
    assert stronger.min() / k.min() == pytest.approx(lost[1] / lost[0], rel=1e-3)
    unknown = effect.edges(*NOTHING, SHOT._replace(temperature=np.nan), at)
    assert np.array_equal(area_matrix(*unknown), k)


# -- quantum yield


def test_flats_of_photons_with_two_electrons():
    """Photons thrown one by one, a tenth of them with two electrons that diffuse on their own."""
    rng = np.random.default_rng(2210)
    side, light, flats, two = 64, 400, 60, 0.1
    found = np.zeros((2, 2))
    level = 0.0
    for _ in range(flats):
        photons = rng.poisson(light * side * side)
        places = rng.uniform(0, side, (2, photons))
        places = np.concatenate([places, places[:, rng.random(photons) < two]], axis=1)
        landed = places + np.sqrt(VARIANCE) * rng.standard_normal(places.shape)
        x, y = np.floor(landed).astype(int) % side
        image = np.bincount(y * side + x, minlength=side**2).reshape(side, side)
        level += image.mean() / flats
        left = image - light * (1 + two)
        found += [[(left * np.roll(left, (-j, -i), (0, 1))).mean() / flats for i in range(2)]
                  for j in range(2)]  # fmt: skip
    effect = quantum_yield(WIDTHS)({"extra": two})
    white = np.zeros((1, 32, 32))
    white[0, 0, 0] = level
    axes = {"wavelength": np.array([REFERENCE]), "back_bias": np.array([BIAS])}
    told = quadrant(effect.covariances(white, axes, LAYOUT), 1)[0]
    noise = level * (1 + two) / np.sqrt(flats) / side * np.array([[np.sqrt(2), 1], [1, 1]])
    np.testing.assert_allclose(found, told, atol=4 * noise.max())
    assert found[0, 0] > level + 12 * noise[0, 0]
    assert min(found[0, 1], found[1, 0]) > 6 * noise[0, 1]
    # All pairs are somewhere: the sum over lags is that of <n^2> / <n>.
    whole = effect.covariances(white, axes, LAYOUT).sum()
    assert whole / level == pytest.approx((1 + 3 * two) / (1 + two))
    assert landing(VARIANCE, 32).sum() == pytest.approx(1)


def test_red_light_and_unknown_light_stay_as_they_are():
    effect = quantum_yield(WIDTHS)({"extra": 0.05})
    c = np.random.default_rng(2211).normal(size=(3, 16, 16))
    axes = {"wavelength": np.array([BLUEST + 1, np.nan, 950.0])}
    assert effect.covariances(c, axes, LAYOUT) is c
    mixed = {"wavelength": np.array([620.0, 370.0, np.nan])}
    out = effect.covariances(c, mixed, LAYOUT)
    assert np.array_equal(out[[0, 2]], c[[0, 2]]) and not np.allclose(out[1], c[1])
    assert extra_electrons(200.0) == pytest.approx(extra_electrons(247.9), rel=1e-3)


@pytest.mark.parametrize(("wavelength", "unit", "sought"), [
    (400.0, "adu2", True), (500.0, "adu2", False), (400.0, PER_ELECTRON, False),
    (np.nan, "adu2", False),
])  # fmt: skip
def test_it_is_sought_in_flats_of_blue_light_alone(wavelength, unit, sought):
    class Told:
        layout = replace(LAYOUT, segments=(None,))

    axes = {"wavelength": np.array([620.0, wavelength]), "level": np.array([1e4, 2e4])}
    channel = Channel("flat_cov", np.zeros(2), (np.eye(2),), axes, unit)
    kinds = [quantum_yield(WIDTHS), charge_diffusion(WIDTHS)]
    left = tellable(kinds, Told(), [channel])
    assert left == (kinds if sought else kinds[1:])


# -- both


@pytest.mark.parametrize("family", [charge_diffusion(WIDTHS), quantum_yield(WIDTHS)])
def test_nothing_of_it_changes_nothing_and_images_are_refused(family):
    (own,) = family.parameters
    none = family({own.name: 0.0})
    c = np.random.default_rng(2212).normal(size=(1, 8, 8))
    assert none.edges(*NOTHING, SHOT, LAYOUT) == NOTHING
    assert none.diffusion_growth(SHOT, LAYOUT) == 0.0
    assert none.covariances(c, {"wavelength": np.array([350.0])}, LAYOUT) is c
    some = family({own.name: own.high})
    assert pickle.loads(pickle.dumps(some)) == some
    with pytest.raises(SensorError, match=family.variant):
        AppliedEffects([some], {}, None, {}, False)
