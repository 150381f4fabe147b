"""Each score against cases made by hand whose answer is known."""

import math

import numpy as np
import pytest

from tests.validation.concealed.reports import found, interval, report, truth
from validation.concealed.card import NOMINAL
from validation.concealed.conventions import expected_location, reading_of
from validation.concealed.library import EFFECTS
from validation.concealed.misses import describe_misses
from validation.concealed.score import (
    FLOOR,
    check_report,
    excess_removed,
    held_parameters,
    location_scores,
    log_score,
    overlap,
    probability_of,
    score_campaign,
)


def test_a_null_without_alarm_and_with_one():
    quiet, loud = (score_campaign(truth(), r) for r in (report(), found("cti_serial")))
    assert (quiet.kind, quiet.detected, quiet.p_value) == ("null", False, 0.5)
    assert loud.detected and loud.named == ("cti_serial",)
    assert describe_misses(quiet) == []
    assert describe_misses(loud) == [
        "nothing was left out: false alarm at p = 1e-06, named cti_serial"
    ]


@pytest.mark.parametrize(
    ("given", "top", "top1", "in_class", "size"),
    [
        (found("cti_serial"), "cti_serial", True, True, 1),
        (found("electronic_memory"), "electronic_memory", False, False, 1),
        (
            found("electronic_memory", equivalence_class=["electronic_memory", "cti_serial"]),
            "electronic_memory", False, True, 2,
        ),
        (found(chances={"cti_serial": 0.6, "tearing": 0.4}), "cti_serial", True, True, 1),
        (found(open_world=True, chances={"cti_serial": 1.0}), "outside_library", False, False, 1),
        (report(equivalence_class=["cti_serial"]), "", False, False, 0),
    ],
)  # fmt: skip
def test_what_is_put_first_and_the_class(given, top, top1, in_class, size):
    score = score_campaign(truth("cti_serial"), given)
    assert (score.top, score.top1, score.in_class) == (top, top1, in_class)
    assert len(score.told_class) == size


def test_log_score_is_the_probability_of_the_truth_with_its_floor():
    given = found("cti_serial", chances={"cti_serial": 0.97, "electronic_memory": 0.03})
    assert log_score(given, "cti_serial") == pytest.approx(-math.log(0.97))
    assert log_score(given, "electronic_memory") == pytest.approx(-math.log(0.03))
    assert log_score(given, "tearing") == pytest.approx(-math.log(FLOOR))
    # probabilities of more than 1 in all buy nothing; of less, what is missing is lost
    greedy = found("tearing", chances={"tearing": 1.0, "cti_serial": 1.0})
    assert probability_of(greedy, "cti_serial") == 0.5
    assert probability_of(found("tearing", chances={"tearing": 0.2}), "tearing") == 0.2
    # what was not detected names nothing
    assert log_score(report(class_probability={"tearing": 1.0}), "tearing") == -math.log(
        FLOOR
    )


def test_several_effects():
    score = score_campaign(
        truth("cti_serial", "tearing", snr=(20.0, 13.0)), found("tearing", "dark_hot")
    )
    assert score.kind == "several" and score.found == ("tearing",)
    assert score.at_least(12) and not score.at_least(14)
    (miss, invention) = describe_misses(score)
    assert miss.endswith("not named: cti_serial") and invention.endswith(
        "invented: dark_hot"
    )


def test_intervals_hold_the_truth_or_not():
    true = truth(
        "trap_serial", parameters={"trap_serial": {"size": 30.0, "tau": 1.5, "amp": 1}}
    )
    given = found("trap_serial", parameters={"trap_serial": {
        "size": interval(33.0, 2.0), "tau": interval(1.6, 0.2), "amp": interval(0.0, 0.1)}})  # fmt: skip
    size, tau = held_parameters(true, given)
    assert (size.name, size.in68, size.in95) == ("size", False, True)
    assert size.error == pytest.approx(0.1)
    assert (tau.in68, tau.in95) == (True, True)
    # a place is no measured number; an effect that is not named has no parameters
    assert held_parameters(true, found("tearing")) == []
    far = found("trap_serial", parameters={"trap_serial": {"size": interval(40.0, 1.0)}})
    (only,) = held_parameters(true, far)
    assert (only.in68, only.in95) == (False, False)
    (miss,) = [m for m in describe_misses(score_campaign(true, far)) if "95 %" in m]
    assert "size = 30, outside the 95 % interval 38 to 42" in miss


def test_intervals_that_are_not_given_are_not_counted():
    true = truth("cti_serial", parameters={"cti_serial": {"cti": 1e-6}})
    given = found("cti_serial", parameters={"cti_serial": {"cti": {"value": 2e-6}}})
    (held,) = held_parameters(true, given)
    assert held.in68 is None and held.error == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["zx", "device zx"])
def test_a_device_parameter_is_held_by_its_distance_from_the_card(name):
    true = truth(
        "device_parameter", parameters={"device_parameter": {"zx": NOMINAL["zx"] + 0.4}}
    )
    said = {"device_parameter": {name: interval(NOMINAL["zx"] + 0.5, 0.06)}}
    (held,) = held_parameters(true, found("device_parameter", parameters=said))
    assert held.error == pytest.approx(0.25) and (held.in68, held.in95) == (False, True)
    # another parameter than the true one is none of these
    other = {"device_parameter": {"zy": interval(2.3, 0.1)}}
    assert held_parameters(true, found("device_parameter", parameters=other)) == []


def test_conventions_name_parameters_that_exist():
    from validation.concealed.conventions import LAGS, READINGS

    for word, name in READINGS:
        if word != "device_parameter":
            assert any(name in v for v in EFFECTS[word].variants.values()), (word, name)
    assert set(EFFECTS["device_parameter"].variants) <= {n for w, n in READINGS}
    assert set(LAGS) <= set(EFFECTS)
    # signed and per +20 V, in codes, per minute, in e-: as truths tell them
    for word, name in [("voltage_dependence", "delta"), ("adc_bits", "delta"),
                       ("cosmic_rays", "rate"), ("saturation", "full_well")]:  # fmt: skip
        reading = reading_of(word, name)
        assert (reading.scored, reading.origin, reading.scale) == (True, 0.0, 1.0)


def test_voltage_dependence_grows_shifts_by_delta_for_twenty_volts_more():
    """The convention by the generator itself: -40 V is +20 V from the nominal -60 V."""
    from validation.concealed.electrostatics import EdgeShifts
    from validation.concealed.library import make_effect
    from validation.concealed.plan import Exposure, Geometry
    from validation.concealed.readout import Context

    context = Context(
        Exposure("FLAT", 0, 60000.0, 1.0, back_bias=-40.0), Geometry(64), None, None, {}
    )
    one = np.ones((3, 3))
    effect = make_effect("voltage_dependence", {"delta": 0.1})
    assert effect.shifts(EdgeShifts(one, one), context).kx[0, 0] == pytest.approx(1.1)


def test_open_world_calls():
    foreign, known = truth("outside_library"), truth("cti_serial")
    said = found("outside_library", open_world=True)
    assert score_campaign(foreign, said).outside
    assert not score_campaign(foreign, said).library_named
    wrong = score_campaign(foreign, found("tearing"))
    assert not wrong.outside and wrong.library_named
    hedged = score_campaign(foreign, found("tearing", open_world=True))
    assert hedged.outside and hedged.library_named
    assert score_campaign(known, said).outside
    assert not score_campaign(foreign, report(open_world=True)).outside
    assert describe_misses(wrong) == [
        "outside_library: not said to be outside the library",
        "outside_library: explained by tearing",
    ]


@pytest.mark.parametrize(
    ("before", "after", "removed"),
    [(9.0, 1.0, 1.0), (9.0, 3.0, 0.75), (3.0, 3.0, 0.0), (1.05, 1.0, np.nan), (9.0, None, np.nan)],
)  # fmt: skip
def test_excess_removed(before, after, removed):
    held = {"chi2dof_before": before, "chi2dof_after": after}
    assert excess_removed(found("tearing", heldout=held))[0] == pytest.approx(
        removed, nan_ok=True
    )


def test_excess_is_significant_by_the_number_of_values():
    held = {"chi2dof_before": 1.1, "chi2dof_after": 1.0}
    for values, significant in ((1000, False), (10000, True)):
        given = found("tearing", heldout={**held, "values": values})
        assert np.isfinite(excess_removed(given)[0]) == significant


def test_location():
    coupling = truth("interpixel_coupling", where={"flux": {"flat_cov": [2e4, 1e5]}})

    def told(**where):
        return location_scores(coupling, found("interpixel_coupling", location=where))

    right = told(lags=[[1, 0]], amps=[1, 2], flux_e=[2e4, 6e4])
    assert right["lags"] is True and right["amps"] is True
    assert right["flux"] == pytest.approx(0.5) and math.isnan(right["x"])
    wrong = told(lags=[[1, 0], [2, 0]], amps=[2], flux_e=[])
    assert wrong["lags"] is False and wrong["amps"] is False and math.isnan(wrong["flux"])
    assert told(lags=[], amps=[])["lags"] is False
    # no location without a detection
    assert location_scores(coupling, report())["lags"] is None


def test_location_of_places_and_of_time():
    torn = truth("tearing")
    assert expected_location(torn)["x"] == [122, 134]
    assert location_scores(torn, found("tearing", location={"x": [122, 128]}))["x"] == 0.5
    trap = truth("trap_serial", parameters={"trap_serial": {"amp": 1}})
    assert expected_location(trap)["amps"] == [2]
    drift = truth("gain_drift")
    first, last = expected_location(drift)["exposures"]
    said = found("gain_drift", location={"exposures": [first + 1, last - 4]})
    assert location_scores(drift, said)["exposures"] == 4
    assert location_scores(drift, found("gain_drift"))["exposures"] == math.inf
    assert expected_location(truth("tearing", "gain_drift")) == {}


def test_overlap_is_symmetric_and_of_equal_points_whole():
    assert overlap([0, 4], [1, 2]) == overlap([1, 2], [0, 4]) == 0.25
    assert overlap([3, 3], [3, 3]) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "2"}, "c_1: report.json: schema = '2', must be"),
        ({"p_value": 3.0}, "p_value = 3.0: 0 to 1"),
        ({"detected": "yes"}, "detected = 'yes' is a str"),
        ({"effects": [{"class": "cti"}]}, "class 'cti' is not in the taxonomy"),
        ({"class_probability": {"Tearing": 1.0}}, "class 'Tearing' is not"),
    ],
)
def test_reports_against_the_contract(change, message):
    with pytest.raises(ValueError, match=message):
        check_report(report(**change), "c_1")
    broken = report()
    del broken["heldout"]
    with pytest.raises(ValueError, match=r"c_1: report\.json: no 'heldout'"):
        check_report(broken, "c_1")


def test_no_report_is_a_miss_and_no_false_alarm():
    score = score_campaign(truth("tearing", snr=20.0), None)
    assert not score.detected and math.isnan(score.p_value) and not score.answered
    assert describe_misses(score) == ["no report"]
