"""Effects by another law than the library's: named as their class, with the law said apart."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.detect.model_error import charge, overlap
from bfsensor.diagnose.explain import stepwise
from bfsensor.diagnose.explain.law_terms import OwnChange, law_choices, law_family
from bfsensor.diagnose.explain.stepwise import attribute
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.report.attribution_words import said_of
from bfsensor.effects.cti_serial import CtiSerial
from bfsensor.effects.electronic_memory import ElectronicMemory
from bfsensor.effects.gain_drift import GainDrift
from bfsensor.effects.shutter_timing import ShutterTiming
from tests.virtual import fit_virtual, make_effect, virtual_baseline


def _deferred(size, power):
    """The null of 9137 with charge in the first overscan pixel that goes with a power of the level."""
    measured, *_ = fit_virtual(seed=9137)

    def changed(channel):
        if channel.word != "serial_overscan":
            return channel
        x = channel.axes
        more = size * np.where(x["k"] == 1, (x["level"] / 4e4) ** power, 0.0)
        return replace(channel, values=channel.values + more)

    return replace(measured, channels=tuple(changed(c) for c in measured.channels))


@lru_cache(maxsize=2)
def _located(size, power):
    predictor, fit = fit_bounded(_deferred(size, power), virtual_baseline())
    return Model(predictor, fit), locate_mismatch(fit)


KINDS = (CtiSerial, GainDrift)


@pytest.fixture(scope="module")
def root():
    """Deferred charge as the root of the signal, where the library knows a proportional loss."""
    return _located(8.0, 0.5)


@pytest.mark.slow
def test_a_class_by_another_law_is_named_and_its_law_said_apart(root):
    model, mismatch = root
    assert mismatch.detected and model.fit.chi2()["serial_overscan"][0] > 1e4
    told = attribute(model.predictor, model.fit, mismatch, kinds=KINDS)
    assert [f.effect.word for f in told.found] == ["cti_serial"] and not told.open_world
    assert told.probability["cti_serial"] > 0.7
    # The proportional loss takes most; the rest is another power of the level.
    assert 0.5 < told.shares["effects"] < 0.98 and told.shares["laws"] > 0.02
    assert told.shares["outside"] == 0
    said = " ".join(said_of(told))
    assert "asks for another law" in said and "explains it" not in said


@pytest.mark.slow
def test_without_other_laws_the_same_mismatch_is_described_freely(root, monkeypatch):
    model, mismatch = root
    monkeypatch.setattr(stepwise, "law_choices", lambda *a: [])
    told = attribute(model.predictor, model.fit, mismatch, kinds=KINDS)
    assert told.free_form is not None and told.free_form.group == "readout filter"


def test_terms_of_a_law_act_only_where_the_effect_does(root):
    model, _ = root
    after = model.with_effects([CtiSerial({"cti": 1e-6})])
    change = OwnChange(after.predictor, after.fit.values, after.effects)
    (choice, *_) = law_choices(change, after.fit)
    assert choice.family.group == "law of cti_serial in serial_overscan"
    assert any("step" in t.name or "time" in t.name for t in choice.terms)
    for channel in after.fit.channels:
        column = choice.terms[0].column(channel)
        if channel.word != "serial_overscan":
            assert column is None
        else:
            assert np.all(column[change(channel) == 0] == 0) and column.any()
    names = [t.name for t in choice.terms]
    again = law_family(change, after.fit, "serial_overscan", names)
    assert not set(names) & {t.name for t in again.terms}


def test_what_errors_of_a_prediction_can_make_is_no_evidence():
    model, _ = _located(8.0, 0.5)
    fit = model.fit
    own = np.zeros(len(fit.residuals))
    rows = np.nonzero(fit.of("serial_overscan"))[0]
    own[rows] = 10.0
    template = np.zeros(len(fit.left))
    template[rows] = 3.0
    errors = {"serial_overscan": 0.1}
    # All values wrong by 10 % in one direction: 0.1 x 10 sqrt(n).
    assert overlap(fit, template, own, errors) == pytest.approx(np.sqrt(len(rows)))
    apart = np.zeros(len(fit.left))
    apart[np.nonzero(fit.of("flat_mean"))[0]] = 3.0
    assert overlap(fit, apart, own, errors) == 0


def test_the_charge_is_what_the_best_of_many_gains_by_chance():
    rng = np.random.default_rng(8317)
    best = (rng.standard_normal((20_000, 30, 2)) ** 2).sum(2).max(1)
    # 200 of 20,000 are expected beyond; 5 sigma.
    assert abs((best > charge(2, 30)).sum() - 200) < 5 * np.sqrt(200)


@pytest.mark.slow
def test_the_law_of_an_effect_takes_no_more_than_the_effect_itself():
    """An echo changes all means alike and by little: exposures of another length are no law of it."""
    predictor, fit = fit_virtual(
        seed=9137,
        effects=[
            make_effect("electronic_memory", {"alpha": -1.5e-4}),
            make_effect("shutter_timing", {"dt": -0.012, "shade": 0.0}),
        ],
    )[1:]
    model = Model(predictor, fit)
    after = model.with_effects([ElectronicMemory({"alpha": -1.5e-4})])
    change = OwnChange(after.predictor, after.fit.values, after.effects)
    flats = after.fit.of("flat_mean")
    left = float(np.square(after.fit.residuals[flats]).sum())
    assert left > 3 * float(np.square(change.whitened(after.fit)[flats]).sum())
    assert "flat_mean" not in [c.family.words[0] for c in law_choices(change, after.fit)]
    told = attribute(
        predictor, fit, locate_mismatch(fit), kinds=(ElectronicMemory, ShutterTiming)
    )
    assert {f.effect.word for f in told.found} == {"electronic_memory", "shutter_timing"}
    assert not told.open_world
