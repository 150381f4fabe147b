"""Stepwise attribution: effects that a baseline lacks are named with parameters; nulls name none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.detect.candidate_screen import Rival, Screen, evidence
from bfsensor.diagnose.detect.candidates import with_fitted
from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.detect.model_error import charge
from bfsensor.diagnose.explain.attribution import class_probabilities, tied_classes
from bfsensor.diagnose.explain.explanation import Explanation
from bfsensor.diagnose.explain.location import place_effects
from bfsensor.diagnose.explain.nonparametric import compete
from bfsensor.diagnose.explain.stepwise import LONGEST, _Search, attribute
from bfsensor.diagnose.explain.terms import Scene
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.fit.likelihood_profile import valley_of
from bfsensor.effects.charge_loss import ChargeLoss
from bfsensor.effects.gain_nonlinearity import GainNonlinearity
from bfsensor.effects.interpixel_coupling import InterpixelCoupling
from bfsensor.effects.tearing import Tearing
from bfsensor.effects.trap_serial import TrapSerial
from bfsensor.errors import ConvergenceError
from tests.virtual import fit_virtual, make_effect

KINDS = (ChargeLoss, GainNonlinearity, InterpixelCoupling, Tearing, TrapSerial)


def fitted(seed, *effects):
    _, predictor, fit = fit_virtual(seed=seed, effects=effects)
    return predictor, fit, locate_mismatch(fit)


def explained(seed, *effects):
    return attribute(*fitted(seed, *effects), kinds=KINDS)


@pytest.fixture(scope="module")
def torn():
    return explained(
        7101, make_effect("tearing", {"amp": 0.008, "length": 2.0, "column": 0.3})
    )


def test_an_effect_is_named_with_its_parameters(torn):
    found = torn.found[0]
    assert found.effect.word == "tearing" and torn.probability["tearing"] > 0.7
    told = found.intervals()
    # 3 sigma; the tear is open in 0.7 of the rows on average, in a few tens of exposures.
    for name, truth, more in (("amp", 0.008, 0.0015), ("length", 2.0, 0.2)):
        width = 1.5 * (told[name]["hi68"] - told[name]["lo68"]) + more
        assert abs(told[name]["value"] - truth) < width, name
    assert abs(told["column"]["value"] * 128 - 0.3 * 128) < 1.0


def test_the_likelihood_profile_about_a_fit_has_the_fits_minimum_and_errors(torn):
    """The profile's minimum and errors are those of the fit, all other parameters refitted."""
    # Fitted again from its end, so that random effects are linearised where the profile is.
    model = Model(torn.predictor, torn.fit)
    model = model.with_effects(model.effects)
    valley = valley_of(model, 0)
    errors = np.array(list(model.errors(0).values()))
    np.testing.assert_allclose(valley.errors, errors, rtol=0.05)
    # Gauss-Newton steps end where they gain a hundredth; the logarithm of errors that random
    # effects widen is counted apart.
    assert abs(valley.square + model.fit.chance - model.fit.total) < 0.5
    aside = valley.best + 0.5 * errors * [1.0, 0.0, 0.0, 0.0]
    assert (valley.left(aside) ** 2).sum() > valley.square


def test_recordings_that_were_not_fitted_agree_better(torn):
    before, after = torn.chi2dof()
    square_before, square_after, values = torn.heldout["flat_map"]
    assert square_before - square_after > 15
    # Scatter of a chi-square of so many values, 4 sigma.
    assert abs(square_after / values - 1) < 4 * np.sqrt(2 / values) + 0.05
    assert after < before


@pytest.mark.slow
def test_a_twin_is_in_the_class():
    """Charge loss and a nonlinear gain have nearly the same mean at eight levels."""
    found = explained(7102, make_effect("charge_loss", {"q": 5e-8})).found
    assert "charge_loss" in {w for f in found for w in f.tied}
    assert len(found) == 1


def test_nothing_is_named_where_nothing_stands_out():
    predictor, fit, mismatch = fitted(7103)
    assert not mismatch.detected
    out = attribute(predictor, fit, mismatch, kinds=KINDS)
    assert out.found == () and not out.open_world and out.probability == {}


def test_a_screen_finds_the_amplitude_to_its_error():
    truth = 12.0
    effect = make_effect("trap_serial", {"size": truth, "tau": 1.5, "amp": 1})
    predictor, fit, _ = fitted(7104, effect)
    screen = Screen(predictor, fit)
    best = screen.best(screen.tried(TrapSerial))
    assert best.effect["amp"] == 1.0
    error = truth / np.sqrt(best.gain)
    # 4 sigma; tau is fitted too, which doubles the error.
    assert abs(best.effect["size"] - truth) < 8 * error + 0.01 * truth


@pytest.mark.slow
def test_an_effect_that_takes_all_stands_before_terms_that_take_less():
    """However many effects were tried: the mismatch is there, and terms do not describe it better."""
    predictor, fit, mismatch = fitted(
        7101, make_effect("tearing", {"amp": 0.006, "length": 2.0, "column": 0.3})
    )
    search = _Search(KINDS, 1, mismatch, [])
    base = Model(predictor, fit)
    now = Explanation(base, base, mismatch, 10**20, search.locate)
    (terms, *_) = compete(Scene(base), mismatch)
    after, ranking = search._step(now)
    assert [p.name for p in after.parts] == ["tearing"] and not after.free
    assert ranking[0].gain < now.charge(ranking[0].effect) and terms.score > 0
    # Terms that take more than any effect are outside the library.
    assert search._faint(now, ranking, 100.0) is None


def rival(kind, values, gain, z, template):
    return Rival(kind(values), gain, z, np.asarray(template, float))


def test_probabilities_and_ties_follow_evidence_and_gain():
    loss = rival(ChargeLoss, {"q": 1e-7}, 40.0, 15.0, [1, 0, 0])
    bent = rival(GainNonlinearity, {"c2": 1e-3, "c3": 0.0}, 38.0, 13.0, [0.99, 0.1, 0])
    torn = rival(
        Tearing,
        {"amp": 0.1, "length": 2.0, "column": 0.5, "open": 0.4},
        9.0,
        0.0,
        [0, 0, 1],
    )
    out = class_probabilities([loss, bent, torn])
    assert out["charge_loss"] == pytest.approx(1 / (1 + np.exp(-2.0)), rel=1e-5)
    assert tied_classes(loss.effect, [loss, bent, torn]) == (
        "charge_loss",
        "gain_nonlinearity",
    )


def test_an_effect_that_was_fitted_has_the_gain_of_its_fit():
    """A search that ended short of it must not make another one more probable."""
    loss = rival(ChargeLoss, {"q": 1e-7}, 400.0, 195.0, [1, 0])
    short = rival(GainNonlinearity, {"c2": -5e-3, "c3": -8e-4}, 350.0, 170.0, [1, 0])
    bent = GainNonlinearity({"c2": -8e-3, "c3": 6e-4})
    assert class_probabilities([loss, short])["charge_loss"] > 0.999
    out = with_fitted([loss, short], bent, 410.0)
    assert [r.effect for r in out] == [bent, loss.effect]
    assert class_probabilities(out)["gain_nonlinearity"] > 0.99
    assert with_fitted([loss, short], bent, 300.0) == [loss, short]


def test_evidence_falls_with_the_room_a_parameter_has():
    """Laplace: gain/2 + ln prior + ln of the Gaussian's volume, prior flat in the logarithm."""
    effect = ChargeLoss({"q": 5e-8})
    (p,) = ChargeLoss.parameters
    sigma = 5e-9
    expected = (
        50.0
        - np.log(5e-8 * np.log(p.high / p.low))
        + 0.5 * np.log(2 * np.pi)
        + np.log(sigma)
    )
    assert evidence(effect, [p], 100.0, np.array([[1 / sigma]])) == pytest.approx(
        expected, abs=0.1
    )


def test_a_found_effect_says_itself_where_it_is(torn):
    """A tear of two pixels' length at column 38 of 128: columns around it, by its own template."""
    placed = place_effects(torn, torn.fit, (128, 128), 2)
    assert placed["channels"][0] == "flat_map"
    low, high = placed["x"]
    assert 26 <= low < 38 < high <= 52
    none = replace(torn, found=())
    assert place_effects(none, torn.fit, (128, 128), 2) is None


def test_an_effect_pays_for_the_places_it_was_tried_at():
    _, predictor, fit = fit_virtual(seed=7101, effects=())
    model = Model(predictor, fit)
    one = Explanation(model, model, locate_mismatch(fit), 60, locate=lambda m: None)
    loss = ChargeLoss(ChargeLoss.starts(predictor.layout)[0])
    starts = Tearing.starts(replace(predictor.layout, sightings=()))
    assert one.charge(loss) == charge(1, 60)
    assert one.charge(Tearing(starts[0])) == charge(4, 60 * len(starts)) > charge(4, 60) + 8


def test_behind_terms_only_what_gained_is_asked_and_all_before_the_search_ends(monkeypatch):
    """What gained nothing before terms is asked again only where nothing else is added."""
    loss = rival(ChargeLoss, {"q": 1e-7}, 400.0, 195.0, [1, 0])
    bent = rival(GainNonlinearity, {"c2": -5e-3, "c3": -8e-4}, 0.5, 0.1, [0, 1])
    seen = SimpleNamespace(detected=True)
    begun = SimpleNamespace(mismatch=seen, parts=(), free=())
    termed = SimpleNamespace(mismatch=seen, parts=(), free=("terms",))
    asked_for = []

    def step(now, asked=None):
        asked_for.append(asked)
        return (termed, [loss, bent]) if now is begun else None

    search = _Search(KINDS, 1, seen, [])
    monkeypatch.setattr(search, "_step", step)
    monkeypatch.setattr(search, "_net", lambda now, r: r.gain)
    assert search.forward(begun) == (termed, {})
    assert asked_for == [None, [ChargeLoss], None]
    assert search.nearest == [loss, bent]


def test_a_rival_whose_joint_fit_scores_worse_is_behind_and_one_without_a_fit_is_out(
    monkeypatch,
):
    """A screen to first order may promise more than the fit keeps: that is no tie and no doubt."""
    own = rival(ChargeLoss, {"q": 1e-7}, 400.0, 195.0, [1, 0])
    worse = rival(GainNonlinearity, {"c2": -5e-3, "c3": -8e-4}, 9e4, 4e4, [0, 1])
    lost = rival(InterpixelCoupling, {"ax": 1e-3, "ay": 1e-3}, 8e4, 3e4, [0, 1])

    def exchange(effect, model):
        assert model is None
        if effect is lost.effect:
            raise ConvergenceError("no fit")
        return SimpleNamespace(score=1100.0)

    now = SimpleNamespace(score=1000.0)
    part = SimpleNamespace(name=own.effect.name, by_law={})
    search = _Search(KINDS, 1, SimpleNamespace(detected=True), [])
    place = SimpleNamespace(with_effect=exchange)
    better, ranking = search._exchanged(now, place, part, [worse, lost, own])
    assert better is None and [r.effect for r in ranking] == [own.effect, worse.effect]
    assert ranking[1].gain == pytest.approx(300) and ranking[1].evidence == pytest.approx(
        145
    )
    assert tied_classes(own.effect, ranking) == ("charge_loss",)
    now = SimpleNamespace(score=1200.0)
    monkeypatch.setattr(search, "forward", lambda other: (other, {}))
    better, _ = search._exchanged(now, place, part, [worse, lost, own])
    assert better.score == 1100.0


def test_a_search_that_takes_too_long_ends_with_what_it_has(monkeypatch):
    seen = SimpleNamespace(detected=True)
    found = SimpleNamespace(mismatch=seen, parts=(), free=())
    search = _Search(KINDS, 1, seen, [])
    monkeypatch.setattr(search, "_step", lambda now, asked=None: (found, []))
    assert not search._late() and search.notes == []
    search.ends -= 2 * LONGEST
    assert search.forward(found) == (found, {})
    (note,) = search.notes
    assert "ended after 300 CPU seconds" in note
