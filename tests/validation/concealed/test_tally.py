"""Many campaigns: each line's number, its trials, its bounds, and what is reached."""

import math

import numpy as np
import pytest

from tests.validation.concealed.reports import found, interval, report, truth
from validation.concealed.misses import print_misses
from validation.concealed.score import score_campaign
from validation.concealed.tally import (
    GOALS,
    mean,
    median,
    print_lines,
    share,
    tally,
    wilson,
)


def lines(*pairs, cost=None):
    scores = [score_campaign(t, r, cost) for t, r in pairs]
    return {line.quantity: line for line in tally(scores)}


def counted(found_lines, quantity):
    return found_lines[quantity].hits, found_lines[quantity].trials


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [
        # Wilson 1927 by hand: centre (k + z^2/2) / (n + z^2), z = 1.959964
        (0, 15, 0.0, 0.2039),
        (0, 125, 0.0, 0.0298),
        (1, 130, 0.0014, 0.0423),
        (25, 25, 0.8668, 1.0),
        (5, 10, 0.2366, 0.7634),
    ],
)
def test_wilson_bounds(hits, trials, low, high):
    assert wilson(hits, trials) == pytest.approx((low, high), abs=5e-5)
    z, n, p = 1.959963984540054, trials, hits / trials
    middle = (p + z * z / 2 / n) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / 4 / n / n)
    assert wilson(hits, trials) == pytest.approx((middle - half, middle + half), abs=1e-12)


def test_no_trials_have_no_bounds():
    assert all(math.isnan(b) for b in wilson(0, 0))
    assert share("x", []).reached() == ""


def test_false_alarms_and_evenness():
    rng = np.random.default_rng(91)
    even = [(truth(), report(p_value=float(p))) for p in rng.uniform(0.02, 1.0, 98)]
    found_ = lines(*even, *[(truth(), found("tearing", p=0.005))] * 2)
    line = found_["false alarms on nulls, p < 0.01"]
    assert (line.hits, line.trials, line.reached()) == (2, 100, "pass")
    assert found_["null p-values against even, KS p"].reached() == "moonshot"
    small = [(truth(), report(p_value=float(p) ** 3)) for p in rng.uniform(0.3, 1.0, 100)]
    assert lines(*small)["null p-values against even, KS p"].value < 1e-3
    # campaigns that gave no report are no trials
    assert lines((truth(), None))["false alarms on nulls, p < 0.01"].trials == 0


def test_detection_by_projected_snr():
    seen, missed = found("tearing"), report()
    all_ = lines(
        *[(truth("tearing", snr=5.0), seen)] * 3,
        (truth("tearing", snr=4.5), missed),
        (truth("outside_library", snr=8.0), seen),
        (truth("tearing", snr=3.0), missed),
        (truth("tearing", "dark_hot", snr=5.0), missed),
    )
    assert (
        all_["detected, SNR 4 to 6.25 (5)"].hits,
        all_["detected, SNR 4 to 6.25 (5)"].trials,
    ) == (3, 4)
    assert all_["detected, SNR 6.25 to 10 (8)"].trials == 1
    assert all_["detected, SNR 3 to 4"].hits == 0
    assert "detected, SNR not known" not in all_
    assert lines((truth("tearing"), seen))["detected, SNR not known"].trials == 1


def test_names_count_from_snr_8_and_where_it_is_not_known():
    right, wrong = found("tearing"), found("dark_hot")
    all_ = lines(
        (truth("tearing", snr=9.0), right), (truth("tearing"), right),
        (truth("tearing", snr=9.0), wrong), (truth("tearing", snr=7.9), wrong),
        (truth("tearing", snr=20.0), found("dark_hot", chances={"dark_hot": 0.5, "tearing": 0.5},
                                           equivalence_class=["dark_hot", "tearing"])),
    )  # fmt: skip
    assert (
        all_["first named is true, SNR >= 8"].hits,
        all_["first named is true, SNR >= 8"].trials,
    ) == (2, 4)
    assert all_["truth in reported class, SNR >= 8"].hits == 3
    assert all_["classes reported, SNR >= 8"].value == pytest.approx(1.25)
    nats = [0.0, 0.0, -math.log(1e-3), math.log(2)]
    assert all_["log-score of class [nat], SNR >= 8"].value == pytest.approx(np.mean(nats))


def test_recall_and_precision_count_effects():
    all_ = lines(
        (truth("tearing", "dark_hot", snr=15.0), found("tearing")),
        (truth("tearing", "dark_hot", "fringing", snr=12.0), found("tearing", "fringing", "psf_wings")),
        (truth("tearing", "dark_hot", snr=(15.0, 11.0)), found("psf_wings")),
    )  # fmt: skip
    recall = all_["several effects, recall, SNR >= 12"]
    precision = all_["several effects, precision, SNR >= 12"]
    assert (recall.hits, recall.trials) == (3, 5)
    assert (precision.hits, precision.trials) == (3, 4)


def test_coverage_of_drawn_intervals_is_what_they_say():
    """1000 Gaussian estimates: 68.3 and 95.4 % within 4 sigma of the binomial."""
    rng = np.random.default_rng(17)
    pairs = []
    for shift in rng.standard_normal(1000):
        said = {"cti_serial": {"cti": interval(1e-6 * (1 + 0.1 * shift), 1e-7)}}
        pairs.append((
            truth("cti_serial", snr=20.0, parameters={"cti_serial": {"cti": 1e-6}}),
            found("cti_serial", parameters=said),
        ))  # fmt: skip
    all_ = lines(*pairs)
    for word, share_ in (("68", 0.683), ("95", 0.954)):
        line = all_[f"coverage of {word} % intervals"]
        assert line.trials == 1000
        assert abs(line.value - share_) < 4 * math.sqrt(share_ * (1 - share_) / 1000)
        assert line.reached() == "moonshot"
    error = all_["median relative parameter error, SNR >= 10"]
    assert error.low < 0.0674 < error.high and error.trials == 1000


def test_open_world_held_out_ties_and_time():
    held = {"chi2dof_before": 5.0, "chi2dof_after": 1.2}
    said = found("outside_library", open_world=True, heldout=held)
    all_ = lines(
        (truth("outside_library", snr=12.0), said),
        (truth("outside_library", snr=9.0), found("tearing")),
        (truth("tearing", snr=12.0, tie_broken=True), said),
        (truth("tearing", snr=12.0, tie_broken=False), found("tearing", heldout=held)),
        cost={"wall_s": 50.0},
    )
    assert all_["outside the library: said so, SNR >= 10"].trials == 1
    assert all_["outside the library: named of it, SNR >= 10"].hits == 0
    over = all_["open world claimed, truth in library"]
    assert (over.hits, over.trials, over.reached()) == (1, 2, "no")
    assert all_["held-out excess removed, library"].value == pytest.approx(0.95)
    assert all_["held-out excess removed, free-form"].trials == 1
    assert all_["held-out chi2/dof after the fit"].reached() == "no"
    assert (
        all_["advised recording breaks the tie"].hits,
        all_["advised recording breaks the tie"].trials,
    ) == (1, 2)
    assert all_["longest time of a campaign of size S [s]"].reached() == "pass"


def test_every_goal_has_its_line():
    told = set(lines((truth(), report()), cost={"wall_s": 1.0}))
    told.add("longest time of a campaign of size M [s]")
    assert set(GOALS) <= told


def test_means_and_medians():
    line = mean("x", [1.0, 2.0, 3.0, float("nan")])
    assert (line.value, line.trials) == (2.0, 3)
    assert line.high - line.value == pytest.approx(1.96 / math.sqrt(3))
    # of 20 values the 6th from either end hold the median at 95.9 % (binomial table)
    line = median("x", range(1, 21))
    assert (line.value, line.low, line.high) == (10.5, 6.0, 15.0)


def test_the_printed_table_and_misses(capsys):
    pair = truth("tearing", snr=9.0), report(p_value=0.3)
    scores = [score_campaign(*pair)]
    print_lines(tally(scores))
    out = capsys.readouterr().out
    row = next(r for r in out.splitlines() if r.startswith("detected, SNR 6.25"))
    assert row.split()[-3:] == [">=", "99.5%", "no"] and "0/1" in row
    print_misses(scores)
    assert capsys.readouterr().out == "  c: tearing (SNR 9.0): not detected (p = 0.3)\n"
    print_misses([score_campaign(truth(), report())])
    assert capsys.readouterr().out == "  none\n"
