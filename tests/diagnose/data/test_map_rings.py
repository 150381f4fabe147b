"""Rings in maps: their centre, spacing and strength found, even or not."""

import numpy as np
import pytest

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
