"""Large sensors: single precision and one evaluation of standing patterns change no prediction."""

from functools import lru_cache

import numpy as np
import pytest

from bfsensor.diagnose.explain import pursuit
from bfsensor.diagnose.explain.map_terms import map_families
from bfsensor.diagnose.explain.terms import Scene
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model import map_predictions
from bfsensor.effects.electronic_memory import Settling
from bfsensor.effects.tree_rings import TreeRings
from tests.virtual import fit_virtual

EFFECTS = (
    Settling({"alpha": 3e-4, "tau": 4.0}),
    TreeRings({"amp": 0.01, "period": 20.0, "xc": -50.0, "yc": 90.0, "chirp": 0.0, "phase": 0.1}),
)  # fmt: skip


@lru_cache(maxsize=1)
def _fitted():
    return fit_virtual(seed=9137)


def _changes(effect):
    """Whitened change of the map by an effect, and the type of its Fourier transforms."""
    measured, predictor, _ = _fitted()
    (channel,) = (c for c in measured.channels if c.word == "flat_map" and c.fold == "fit")
    with_it = predictor.with_effects((effect,), predictor.start)
    # Nothing that was cached in another precision.
    with_it.kept._values.clear()
    change = with_it.predict(channel, with_it.start) - predictor.predict(
        channel, predictor.start
    )
    return channel.whiten(change)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda e: e.name)
def test_single_precision_is_far_below_the_errors(monkeypatch, effect):
    double = _changes(effect)
    monkeypatch.setattr(map_predictions, "KEPT_PIXELS", 0)
    single = _changes(effect)
    assert np.abs(double).max() > 0.1
    assert not np.array_equal(double, single)
    # Sums in single precision round by 1e-7; whitened rings divide small differences by errors.
    np.testing.assert_allclose(
        single, double, atol=3e-6 * float(np.linalg.norm(double)), rtol=0
    )


def test_a_standing_pattern_is_that_of_each_flat(monkeypatch):
    (channel,) = (
        c for c in _fitted()[0].channels if c.word == "flat_map" and c.fold == "fit"
    )
    every = channel.axes["map"] == "all"
    once = _changes(EFFECTS[0])
    # Maps that are divided by another one have the same pattern in both.
    assert every.sum() < len(every) and not once[~every].any()
    monkeypatch.setattr(Settling, "maps_vary", "condition")
    each = _changes(EFFECTS[0])
    np.testing.assert_allclose(
        once[every], each[every], atol=1e-9 * float(np.linalg.norm(each)), rtol=0
    )


def test_a_large_dictionary_chooses_what_a_small_one_does(monkeypatch):
    _, predictor, fit = _fitted()
    family = map_families(Scene(Model(predictor, fit)))[0]
    small = pursuit.Dictionary(family, fit)
    monkeypatch.setattr(pursuit, "LARGE", 0)
    monkeypatch.setattr(pursuit, "CHUNK", 100)
    large = pursuit.Dictionary(family, fit)
    assert small.x.dtype == np.float64 and large.x.dtype == np.float32
    assert len(family.terms) > 2 * pursuit.CHUNK
    np.testing.assert_allclose(large.free, small.free, rtol=0, atol=1e-9 * small.free.max())
    n = int(np.argmax(small.free))
    left = fit.left + 20 * small.template(n) / np.sqrt(small.free[n])
    z = [
        d.products(left) / np.sqrt(np.where(d.free > 0, d.free, np.inf))
        for d in (small, large)
    ]
    # Products of some hundred numbers in single precision.
    np.testing.assert_allclose(z[1], z[0], atol=1e-4)
    assert int(np.argmax(np.abs(z[1]))) == int(np.argmax(np.abs(z[0])))
