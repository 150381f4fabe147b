"""The report of a campaign whose mismatch is explained: before and after, ties, advice, omissions."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy.stats import chi2

from bfsensor.diagnose.detect.locate import ALARM, locate_mismatch
from bfsensor.diagnose.detect.model_error import charge
from bfsensor.diagnose.explain.attribution import OUTSIDE_TRUE, OUTSIDE_WORD, RELIABLE
from bfsensor.diagnose.fit.baseline_fit import held_out
from bfsensor.diagnose.plan.advice import plan
from bfsensor.diagnose.report.attribution_words import reported
from bfsensor.diagnose.report.class_words import (
    CLASS_WORDS,
    NAMES,
    PARAMETER_WORDS,
    said_interval,
    said_p,
    said_value,
)
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.diagnose.report.html_report import write_report
from bfsensor.diagnose.report.report_figures import SAME_PIXELS
from bfsensor.effects.charge_diffusion import charge_diffusion
from bfsensor.effects.library import LIBRARY
from bfsensor.effects.quantum_yield import quantum_yield
from bfsensor.effects.simulated_physics import DiffusionWidths
from bfsensor.plots import residuals as show
from tests.virtual import (
    EFFECTS,
)

VOID = {"meta", "img", "link", "br", "hr"}


class Page(HTMLParser):
    """Checks that tags close in order; keeps headings, text and pictures."""

    def __init__(self, text):
        super().__init__()
        self.open, self.headings, self.words, self.pictures = [], [], [], 0
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.pictures += 1
            assert dict(attrs)["alt"] and dict(attrs)["src"].startswith("data:image/png")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        if "style" not in self.open:
            self.words.append(data)


@pytest.fixture(scope="module")
def explained(fitted_loss, tied):
    measured, predictor, fit = fitted_loss
    return Diagnosis(
        campaign="a <small> campaign", baseline="virtual", measured=measured, fit=fit,
        mismatch=locate_mismatch(fit), heldout=held_out(predictor, fit, measured), attribution=tied,
        plan=plan(tied), predictor=predictor, notes=("a note",),
    )  # fmt: skip


@pytest.fixture(scope="module")
def written(explained, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return folder, write_report(explained, folder)


def test_report_json_has_plan_advice_and_what_was_not_tested(explained, written):
    report = json.loads((written[0] / "report.json").read_text())
    assert len(report["recommended_recordings"]) == len(report["plan"]) == 1
    block = report["plan"][0]
    assert set(block["separates"]) == set(report["equivalence_class"])
    assert block["recording"] == "binned_serial" and block["expected_delta_chi2"] > 25
    assert [t["class"] for t in report["not_tested"]] == ["outside_library"]
    assert "Fe55" in report["not_tested"][0]["recording"]
    held = report["heldout"]
    assert held["chi2dof_after"] < 1.2 < held["chi2dof_before"]
    assert held["channels"]["flat_mean"]["before"] > 10
    assert held["channels"]["flat_mean"]["after"] < 2
    assert held["fails_in"] == []
    # Channels without held-out values are left out.
    assert all(row["values"] > 0 for row in held["channels"].values())


def test_channels_that_get_worse_on_held_out_recordings_are_reported(explained):
    told = explained.attribution
    before, after, n = told.heldout["flat_mean"]
    (p,) = (told.heldout_p[w] for w in ["flat_mean"])
    assert p == pytest.approx(chi2.sf(after, n))
    for worse in (before + 2 * charge(1, 1), chi2.isf(0.5 * ALARM, n)):
        held = {**told.heldout, "flat_mean": (before, worse, n)}
        astray = replace(explained, attribution=replace(told, heldout=held))
        assert astray.to_report()["heldout"]["fails_in"] == ["flat_mean"]
        assert f"{NAMES['flat_mean']} (from" in astray.said()
        # Refuted by recordings that were not fitted, an effect explains nothing.
        assert "explains it" not in astray.said()
    assert f"{NAMES['flat_mean']} (from" not in explained.said()


def test_a_part_that_asks_for_another_law_or_remains_is_said_with_its_share(explained):
    told = explained.attribution
    assert "explains it" in explained.said()
    shares = {"effects": 0.7, "laws": 0.2, "outside": 0.1, "left": 0.0}
    part = replace(explained, attribution=replace(told, shares=shares))
    assert "70 % of the chi-square" in part.said() and "another 20 %" in part.said()
    assert "A part, 10 % of" in part.said() and "explains it" not in part.said()


def test_certain_evidence_is_as_probable_as_campaigns_of_others_showed(explained):
    told = explained.attribution
    (found,) = told.found
    sure = replace(found, probability={found.effect.word: 1.0})
    for outside in (False, True):
        given = replace(told, found=(sure,), open_world=outside)
        chances = given.probability
        assert sum(chances.values()) == pytest.approx(1)
        assert next(iter(chances)) == found.effect.word
        assert RELIABLE < chances[found.effect.word] < RELIABLE + 0.03
        others = {
            w: p for w, p in chances.items() if w not in (found.effect.word, OUTSIDE_WORD)
        }
        assert len(others) > 20 and len(set(others.values())) == 1
        extra = chances[OUTSIDE_WORD] - next(iter(others.values()))
        assert extra == pytest.approx(OUTSIDE_TRUE[True] if outside else 0)
    unnamed = replace(told, found=(), open_world=True).probability
    assert next(iter(unnamed)) == OUTSIDE_WORD
    assert OUTSIDE_TRUE[False] < unnamed[OUTSIDE_WORD] < OUTSIDE_TRUE[False] + 0.03
    assert replace(told, found=(), open_world=False).probability == {}


def test_outside_is_claimed_only_where_it_is_more_probable_than_not(explained):
    """What a named effect leaves is another law of it more often than physics outside the library."""
    beside = replace(explained.attribution, open_world=True)
    alone = replace(beside, found=())
    assert [t.outside for t in (explained.attribution, beside, alone)] == [
        False,
        False,
        True,
    ]
    told = reported(beside)
    assert OUTSIDE_WORD not in told["equivalence_class"] and not told["open_world"]
    assert OUTSIDE_WORD not in [e["class"] for e in told["effects"]]
    told = reported(alone)
    assert told["equivalence_class"] == [OUTSIDE_WORD] and told["open_world"]
    assert [e["class"] for e in told["effects"]] == [OUTSIDE_WORD]
    chance = beside.probability[OUTSIDE_WORD]
    sentences = replace(explained, attribution=beside).said()
    assert (
        f"explains the rest; the probability that its physics is outside the library is {chance:.2f}"
        in (sentences)
    )


def test_an_effect_explains_only_where_nothing_is_left(explained):
    told = explained.attribution
    assert not told.mismatch.detected
    whole = explained.said()
    left = replace(told.mismatch, p_value=1e-30)
    part = replace(explained, attribution=replace(told, mismatch=left)).said()
    assert "explains it" in whole and "explains it" not in part
    outside = replace(told, open_world=True)
    assert "explains it:" not in replace(explained, attribution=outside).said()
    assert f"family-wise p {told.mismatch.p_value:.2g}" in whole
    # A p-value at the floor of its calculation is printed as a bound.
    assert "family-wise p < 2e-30" in part


@pytest.mark.parametrize(
    ("value", "printed"),
    [(0.0, "< 1e-30"), (1e-30, "< 1e-30"), (3e-7, "3e-07"), (0.4321, "0.43")],
)
def test_p_values_at_the_floor_are_printed_as_bounds(value, printed):
    assert said_p(value) == printed


def test_intervals_state_ends_that_the_data_do_not_constrain():
    told = {"value": 2.0, "lo68": 1.0, "hi68": 3.0}
    assert said_interval(told, "68") == "1 to 3"
    assert said_interval(told | {"open68": ["hi"]}, "68") == "above 1"
    assert said_interval(told | {"open68": ["lo"]}, "68") == "below 3"
    both = said_interval(told | {"open68": ["lo", "hi"]}, "68")
    assert both != said_interval({"value": 2.0}, "68")
    assert not {"1", "3"} & set(both)


def test_amplifiers_are_counted_from_one_in_sentences():
    # report.json counts the amplifier of a trap from 0.
    assert said_value("trap_serial", "amp", 0.0) == "1"
    assert said_value("tree_rings", "amp", 0.01) == "0.01"


WIDTHS = DiffusionWidths((((620.0, -50.0), 0.05),), 173.15)


def test_parameters_with_words_belong_to_their_class():
    for word, names in PARAMETER_WORDS.items():
        kinds = (*LIBRARY, charge_diffusion(WIDTHS), quantum_yield(WIDTHS))
        own = {p.name for kind in kinds if kind.word == word for p in kind.parameters}
        assert set(names) == own, word


def test_the_page_is_whole_and_says_it_all(written):
    page = Page((written[0] / "report.html").read_text())
    assert page.open == []
    assert page.headings == [
        "Effects found", "What to record next", "Where the recordings differ",
        "Held-out recordings, which were not fitted", "Fitted recordings",
        "Residuals, channel by channel", "Largest deviations from the baseline",
        "Defects of the sensor", "What was not tested", "Notes",
    ]  # fmt: skip
    text = " ".join(page.words)
    assert "a <small> campaign" in text and "a note" in text
    assert "or gain nonlinearity" in text or "or charge loss" in text
    assert "binned by two along the row" in text and "Astier" in text
    assert re.search(r"1\.\d+e-07 to 1\.\d+e-07", text)
    # The limit of held-out flats of the same pixels as evidence.
    assert SAME_PIXELS.strip() in text


def test_figures_come_in_pairs_of_one_scale(written):
    folder, files = written
    names = {p.stem for p in files if p.suffix == ".png"}
    both = {n for n in names if f"{n}_with_effects" in names}
    assert {"channels", "flat_cov", "flat_mean", "spot"} <= both
    assert {"classes", "heldout", "serial_overscan", "flat_map"} <= names
    # Figures that no effect changes are drawn once.
    assert not {"serial_overscan", "flat_map", "bias_cov"} & both
    page = Page((folder / "report.html").read_text())
    assert page.pictures == len(names)
    assert not list(folder.glob("*.tmp*"))


def test_classes_that_were_not_tested_are_listed(explained, tmp_path):
    kept = tuple(
        c for c in explained.measured.channels if c.word not in ("spot", "dark_map")
    )
    less = replace(explained, measured=replace(explained.measured, channels=kept))
    report = less.to_report()
    told = {entry["class"]: entry for entry in report["not_tested"]}
    assert (
        told["psf_wings"]["because"] == "no spot"
        and "spots" in told["psf_wings"]["recording"]
    )
    assert "cti_serial" not in told
    write_report(less, tmp_path)
    text = " ".join(Page((tmp_path / "report.html").read_text()).words)
    assert "What was not tested" in text and "no darks" in text


def test_classes_have_plain_words():
    # Physics of the silicon is sought with a device, not by the library.
    assert set(CLASS_WORDS) == {*EFFECTS, "silicon_physics"}


def test_figures_of_the_summary_draw_what_they_are_given():
    from matplotlib.figure import Figure

    ax = Figure().add_subplot()
    show.draw_classes({"cti_serial": 0.9, "trap_serial": 0.1}, ax, tied=["cti_serial"])
    widths = [bar.get_width() for bar in ax.patches]
    assert widths == [0.1, 0.9]
    colours = {bar.get_facecolor() for bar in ax.patches}
    assert len(colours) == 2
    ax = Figure().add_subplot()
    show.draw_held_out({"flats": (50.0, 1.1, 100), "spots": (1.2, 1.0, 20)}, ax)
    marks = [
        line.get_xdata()[0] for line in ax.lines if len(np.ravel(line.get_xdata())) == 1
    ]
    assert sorted(marks) == [1.0, 1.1, 1.2, 50.0]
    low, high = ax.get_xlim()
    assert low < 1 < 50 < high
