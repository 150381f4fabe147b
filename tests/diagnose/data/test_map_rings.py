"""Rings in maps: their centre, spacing and strength found, even or not."""

import numpy as np
import pytest

from bfsensor.diagnose.data import map_waves
from bfsensor.diagnose.data.map_rings import WAFER, find_radial, find_rings
from bfsensor.diagnose.data.map_waves import find_patterns
from bfsensor.diagnose.model.map_predictions import area_change
from bfsensor.effects.effect import Layout, Segment, Shot
from bfsensor.effects.tree_rings import TreeRings, UnevenTreeRings

SIDE = 192
LAYOUT = Layout((SIDE, SIDE), (Segment(0, 0, SIDE, SIDE),))
SHOT = Shot("flat", -1, 1.0)
PLACE = {"amp": 0.012, "period": 24.0, "xc": -60.0, "yc": 300.0, "phase": 0.2}
EVEN = TreeRings(PLACE | {"chirp": 0.02})
UNEVEN = UnevenTreeRings(PLACE | {"sway": 0.15, "length": 471.0, "sway_phase": 0.1})


def sightings(effect, noise=2e-3):
    rng = np.random.default_rng(8233)
    change = 0.0 if effect is None else area_change(effect, SHOT, LAYOUT)
    found = change + noise * rng.standard_normal(LAYOUT.shape)
    return [s for s in find_patterns(found, "all") if s["shape"] == "rings"]


@pytest.mark.parametrize("effect", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_rings_are_followed_and_a_fit_may_begin_there(effect):
    found = sightings(effect)
    layout = Layout(LAYOUT.shape, LAYOUT.segments, sightings=tuple(found))
    start = type(effect)(type(effect).starts(layout)[0])
    assert start["amp"] == pytest.approx(0.012, rel=0.1)
    # What is predicted is what is there, whichever numbers say so.
    true, said = (area_change(e, SHOT, LAYOUT) for e in (effect, start))
    assert ((true - said) ** 2).sum() < 0.05 * (true**2).sum()


def test_even_rings_are_not_taken_for_uneven_ones():
    assert all("chirp" in s for s in sightings(EVEN))


def test_noise_has_no_rings():
    assert not sightings(None)


@pytest.mark.parametrize("seed", [1, 3])
def test_rings_are_followed_from_whichever_wave_leads_to_them(seed):
    """The clearest wave may lie in a part of uneven rings where they are evenly spaced."""
    rng = np.random.default_rng(seed)
    effect = UnevenTreeRings(
        PLACE | {"sway": 0.15, "length": 467.5, "sway_phase": 0.0, "phase": 0.25}
    )
    layout = Layout((256, 256), (Segment(0, 0, 256, 256),))
    true = area_change(effect, SHOT, layout)
    found = find_patterns(true + 2.7e-3 * rng.standard_normal(layout.shape), "all")
    start = next(s for s in found if s["shape"] == "rings")
    assert "sway" in start
    said = area_change(
        UnevenTreeRings({p.name: start[p.name] for p in effect.parameters}), SHOT, layout
    )
    assert ((true - said) ** 2).sum() < 0.05 * (true**2).sum()


@pytest.mark.parametrize("far", [2e4, 1e5])
def test_rings_have_their_centre_on_a_wafer(far):
    """Straight waves, as of a mask, fit rings about a centre a metre away equally well."""
    y, x = np.indices((96, 96)) * 2.0
    r = np.hypot(x + far, y - 90.0)
    wave = 8.0 * np.sin(2 * np.pi * (r - far) / 43.0)
    wave += np.random.default_rng(8).standard_normal(wave.shape)
    radial = find_radial(wave, x, y, [(-far, 90.0)], least=35.0)
    rings = find_rings(wave, x, y, (-far, 90.0, 43.0, 0.0))
    assert (radial is not None) == bool(rings) == (far < WAFER)


BENT = map_waves.Wave(40.0, 30.0, 0.03, -0.02, 2e-4, -1.5e-4, 1e-4, 0.8, -0.5)


def test_a_wave_is_the_same_about_any_point():
    """Values at random points, and derivatives by differences of a phase of 1e-5 and less."""
    x, y = np.random.default_rng(71).uniform(0, 80, (2, 50))
    value, slopes = map_waves._model(BENT, x, y)
    moved, _ = map_waves._model(BENT.about(12.0, 55.0), x, y)
    np.testing.assert_allclose(moved, value, atol=1e-12)
    for n, name in enumerate(("fx", "fy", "xx", "xy", "yy", "sine", "cosine")):
        step = 1e-8
        ends = [
            map_waves._model(BENT._replace(**{name: getattr(BENT, name) + s}), x, y)[0]
            for s in (-step, step)
        ]
        np.testing.assert_allclose(
            slopes[:, n], (ends[1] - ends[0]) / (2 * step), rtol=1e-4, atol=1e-4
        )


@pytest.mark.parametrize("turn", [0.3, 2.0, 4.0, 5.7])
def test_circles_of_one_period_have_their_centre(turn):
    """A phase of r / 25 about a centre 300 pixels away, to second order at (40, 30)."""
    ux, uy, period, radius = np.cos(turn), np.sin(turn), 25.0, 300.0
    curved = 1 / (period * radius)
    wave = map_waves.Wave(
        40.0, 30.0, ux / period, uy / period, curved * uy * uy, -curved * ux * uy,
        curved * ux * ux, 1.0, 0.0,
    )  # fmt: skip
    xc, yc, found, rate = map_waves._circles(wave, 5000.0)
    assert (xc, yc) == pytest.approx((40 - radius * ux, 30 - radius * uy), rel=1e-9)
    assert (found, rate) == pytest.approx((period, 0.0), abs=1e-9)
