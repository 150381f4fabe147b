"""The table of goals: what counts as what, parts by strength, law and layout, causes of misses."""

from __future__ import annotations

import numpy as np
import pytest

from validation.concealed.calibration import coverage_by_class, reliability, stated_of
from validation.concealed.goals import (
    ASKED,
    causes,
    described,
    goals,
    invented,
    splits,
    trial_of,
)
from validation.concealed.score import SCHEMA, score_campaign


def _truth(*effects, name="f0", **more):
    return {
        "campaign": name,
        "size": "S",
        "effects": list(effects),
        "amplifiers": 2,
        **more,
    }


def _effect(word, law, snr, **parameters):
    return {"class": word, "law": law, "snr": snr, "parameters": parameters, "shape": {}}


def _report(*said, p=1e-9, outside=False, channels=None):
    """A report that names (class, law, parameters)."""
    effects = [{"class": w, "law": law, "parameters": given} for w, law, given in said]
    return {
        "schema": SCHEMA, "campaign": "f0", "detected": p < 0.01, "p_value": p,
        "effects": effects, "class_probability": {w: 1.0 / len(said) for w, *_ in said},
        "equivalence_class": [w for w, *_ in said], "open_world": outside, "location": {},
        "recommended_recordings": [], "heldout": {"channels": channels or {}},
    }  # fmt: skip


def _trial(truth, report, wall=20.0):
    return trial_of(truth, score_campaign(truth, report, {"wall_s": wall}), report)


def _line(trials, quantity):
    return next(line for line in goals(trials) if line.quantity == quantity)


def _interval(value, error, **more):
    ends = {"lo68": value - error, "hi68": value + error}
    wide = {"lo95": value - 2 * error, "hi95": value + 2 * error}
    return {"value": value, **ends, **wide, **more}


CTI = _effect("cti_serial", "proportional", 50.0, cti=1e-6)
KING = _effect("psf_wings", "king", 50.0, amp=0.01)


def test_names_are_split_by_law_and_counted_from_snr_8_on():
    good = _trial(_truth(CTI), _report(("cti_serial", "proportional", {})))
    wrong = _trial(_truth(CTI), _report(("trap_serial", "trap", {})))
    other = _trial(_truth(KING), _report(("psf_wings", "", {})))
    weak = _trial(_truth({**CTI, "snr": 7.0}), _report(("trap_serial", "trap", {})))
    trials = [good, wrong, other, weak]
    own = _line(trials, "named first right, SNR >= 8, a law of the library")
    assert (own.hits, own.trials) == (1, 2) and own.reached() == "no"
    another = _line(trials, "named first right, SNR >= 8, another published law")
    assert (another.hits, another.trials) == (1, 1) and another.reached() == "moonshot"
    assert _line(trials, "detected, SNR 6.25 to 10 (8)").trials == 1


def test_a_campaign_without_a_report_is_counted_and_fails_the_goal():
    trials = [_trial(_truth(CTI), None), _trial(_truth(), _report(p=0.4))]
    missing = _line(trials, "campaigns without a report")
    assert (missing.hits, missing.trials, missing.reached()) == (1, 2, "no")
    assert causes(trials[0].score) == "no report" and not causes(trials[1].score)


def test_an_invented_effect_stands_beside_a_true_one():
    beside = _trial(_truth(CTI), _report(("cti_serial", "", {}), ("fringing", "", {})))
    instead = _trial(_truth(CTI), _report(("fringing", "", {})))
    assert invented(beside.score) and not invented(instead.score)
    assert (
        causes(beside.score) == "invented beside" and causes(instead.score) == "wrong name"
    )
    assert _line([beside, instead], "an effect named beside that is not there").hits == 1


@pytest.mark.parametrize(
    ("error", "more", "inside"),
    [
        (2e-7, {}, [True, True]),
        (1e-7, {}, [False, True]),
        (5e-8, {}, [False, False]),
        (5e-8, {"open68": ["lo"], "open95": ["lo"]}, [True, True]),
        (5e-8, {"open68": ["lo", "hi"], "open95": ["hi"]}, [None, False]),
    ],
)
def test_open_ends_hold_the_truth_and_two_say_nothing(error, more, inside):
    given = {"cti": _interval(1.15e-6, error, **more)}
    trial = _trial(_truth(CTI), _report(("cti_serial", "proportional", given)))
    (held,) = trial.held
    assert [held.in68, held.in95] == inside


def test_parameters_of_another_law_are_not_compared():
    given = {"cti": _interval(1e-6, 1e-7)}
    trial = _trial(_truth(CTI), _report(("cti_serial", "two_traps", given)))
    assert not trial.held


def test_held_out_values_count_where_the_explanation_changed_them():
    same, better = {"before": 1.3, "after": 1.3}, {"before": 9.0, "after": 1.05}
    report = _report(
        ("cti_serial", "", {}), channels={"flat_map": same, "flat_cov": better}
    )
    assert _trial(_truth(CTI), report).touched == (1.05,)


def test_parts_are_by_strength_law_layout_and_nuisances():
    layout = {"spots": 0, "serial_overscan": 0}
    trial = _trial(
        _truth(KING, layout=layout, nuisances=[{"kind": "dust"}]),
        _report(("psf_wings", "", {})),
    )
    named = {name for name, own in splits([trial]).items() if own}
    assert named == {
        "SNR 10 to 100", "other published laws", "1 or 2 amplifiers", "without spots",
        "without a serial overscan", "1 to 3 nuisances",
    }  # fmt: skip
    assert described(trial) == "f0: psf_wings/king at 50: psf_wings, p = 1e-09"


def test_every_quantity_has_a_goal_and_nothing_is_reached_without_trials():
    lines = goals([])
    assert [line.quantity for line in lines] == list(ASKED)
    assert all(not line.reached() and not np.isfinite(line.low) for line in lines)


def test_probabilities_are_counted_by_tenths_and_unlisted_truths_at_zero():
    truth = _truth(CTI, KING)
    report = _report(("cti_serial", "", {}))
    report["class_probability"] = {"cti_serial": 0.93, "persistence": 0.07}
    assert set(stated_of(truth, report)) == {(0.93, True), (0.07, False), (0.0, True)}
    lines = reliability(_trial(truth, report).stated)
    assert [(n.hits, n.trials) for n in lines] == [(1, 2), (1, 1)]
    assert stated_of(truth, None) == stated_of(truth, report | {"detected": False}) == ()
    assert reliability([(1.0, True)])[0].quantity == "given 0.9 to 1.0 (mean 1.000): true"


def test_intervals_are_counted_by_class_and_parameter():
    said = [("cti_serial", "proportional", {"cti": _interval(1.15e-6, 1e-7)})]
    held = _trial(_truth(CTI), _report(*said)).held
    lines = {n.quantity: (n.hits, n.trials) for n in coverage_by_class(held)}
    assert lines == {"cti_serial cti, 68 %": (0, 1), "cti_serial cti, 95 %": (1, 1)}
    assert coverage_by_class(()) == []
