"""Trials at channel level: the mix, amplitudes by calibration, sealed before they are diagnosed."""

import json
from collections import Counter

import numpy as np
import pytest
from click.testing import CliRunner

from tests.validation.concealed.reports import report
from validation.challenge import concealed_trials as trials
from validation.challenge import trial_amplitudes as amplitudes
from validation.challenge.trial_amplitudes import Amplitudes, headroom, strongest
from validation.concealed.library import EFFECTS, make_effect
from validation.concealed.opening import Opened, from_row, to_row
from validation.concealed.plan import Size
from validation.concealed.rows import read_rows
from validation.concealed.submit import digest

EVERY = [(w, v) for w, k in EFFECTS.items() for v in sorted(k.variants)]


@pytest.fixture
def calibration(monkeypatch):
    """SNR 40 at a tenth of the range, in proportion; an effect's own twins show half of that."""
    flux = {"flat_cov": (1e4, 1e5)}
    told = {
        key: Amplitudes(0.1, 40.0, 0.025, 10.0, ("flat_cov",), 1.0, flux) for key in EVERY
    }

    def take_signal(effect, size="S"):
        factor = 1 / headroom(effect)
        return amplitudes.Signal(200.0 * factor, ("flat_cov",), 1.0, np.zeros(1), flux)

    def take_like(effect, shown, noise):
        assert shown == ("flat_cov",) and noise == 1.0
        return take_signal(effect)

    monkeypatch.setattr(trials, "take_signal", take_signal)
    monkeypatch.setattr(trials, "take_like", take_like)
    return told


def test_the_mix_is_that_asked_for_and_any_part_has_all():
    mixed = trials.kinds(5)
    assert Counter(mixed) == {"null": 150, "outside": 60, "several": 80, "single": 210}
    assert len(set(mixed[:50])) == 4 and mixed != trials.kinds(6)


@pytest.mark.parametrize(("word", "variant"), EVERY)
def test_every_effect_starts_at_the_top_of_its_range(word, variant):
    top = strongest(word, variant)
    assert headroom(top) == pytest.approx(1.0)
    assert headroom(top.scaled(0.25)) == pytest.approx(4.0)


def test_amplitudes_by_proportion_and_by_power(calibration):
    found = trials.set_amplitude(make_effect("cti_serial", {"cti": 3e-7}), 8.0, calibration)
    assert found.effect.parameters["cti"] == pytest.approx(5e-6 * 0.1 * 8 / 40)
    assert (found.snr, found.capped) == (8.0, False)
    squared = Amplitudes(0.1, 40.0, 0.05, 10.0, (), 0.0, {})
    assert squared.power == pytest.approx(2.0)
    assert squared.factor_of(10.0) == pytest.approx(0.05)


def test_amplitudes_with_a_shape_of_their_own_come_from_their_own_twins(calibration):
    drawn = make_effect("tearing", {"amp": -0.01, "length": 2.0, "column": 0.4})
    found = trials.set_amplitude(drawn, 8.0, calibration)
    # 20 instead of 40 at a tenth of the range
    assert found.effect.parameters["amp"] == pytest.approx(-0.2 * 0.1 * 8 / 20)
    assert found.effect.parameters["length"] == 2.0


def test_what_cannot_be_so_strong_is_as_strong_as_its_range_allows(calibration):
    faint = calibration | {("cti_serial", ""): Amplitudes(1.0, 6.0, 0.5, 3.0, (), 0.0, {})}
    found = trials.set_amplitude(make_effect("cti_serial", {"cti": 3e-7}), 20.0, faint)
    assert found.capped and found.snr == pytest.approx(6.0)
    assert found.effect.parameters["cti"] == pytest.approx(5e-6)
    unseen = calibration | {("cti_serial", ""): Amplitudes(1.0, 0.0, 0.5, 0.0, (), 0.0, {})}
    assert trials.set_amplitude(found.effect, 20.0, unseen)[1:3] == (0.0, True)


def test_the_snr_of_a_told_effect(calibration):
    told = make_effect("cti_serial", {"cti": 1e-6})
    assert trials.snr_of(told, calibration) == pytest.approx(40 * 0.2 / 0.1)
    with pytest.raises(ValueError, match=r"no calibration of cti_serial: run python -m"):
        trials.snr_of(told, {})


def test_rows_are_scored_by_the_snrs_of_now(calibration):
    """Of effects that are nothing but an amplitude; of others their own twins told it."""
    told = [
        ("cti_serial", {"cti": 1e-6}),
        ("psf_wings", {"frac": 0.01, "sigma": 4.0}),
    ]
    for word, parameters in told:
        effect = {"class": word, "parameters": parameters, "snr": 33.0, "capped": False}
        truth = {"campaign": "c", "effects": [effect], "size": "S", "seed": 1}
        row = to_row(Opened(truth, report(), {}, "0"), "channel", "set")
        one = len(make_effect(word, parameters).parameters) == 1
        wanted = trials.snr_of(make_effect(word, parameters), calibration) if one else 33.0
        score = trials.score_now(row, calibration)
        assert score.snr == (pytest.approx(wanted),)
        assert from_row(row).snr == (33.0,)
    assert trials.snr_of(make_effect(*told[0]), calibration) != 33.0 and not one


@pytest.mark.parametrize(
    ("nuisances", "kept"),
    [
        ([{"kind": "dust", "size": 3.0}], ["dust"]),
        ({"gain": 2.0, "noise_e": 5.0}, ["gain", "noise_e"]),
    ],
)
def test_nuisances_are_kept_by_name_from_either_bench(nuisances, kept):
    truth = {"campaign": "c", "effects": [], "size": "S", "seed": 1, "nuisances": nuisances}
    row = to_row(Opened(truth, report(), {}, "0"), "pixel", "set")
    assert json.loads(row["truth_json"])["nuisances"] == kept


def test_truths_are_drawn_again_the_same_and_even_in_the_logarithm(
    calibration, monkeypatch
):
    monkeypatch.setattr(trials, "_own_snr", lambda *_: 7.0)
    truths = [trials.draw_truth(n, 5, calibration) for n in range(500)]
    assert truths[3] == trials.draw_truth(3, 5, calibration)
    assert truths[3] != trials.draw_truth(3, 6, calibration)
    number = Counter(len(t["effects"]) for t in truths)
    assert number[0] == 150 and number[1] == 270 and number[2] + number[3] == 80
    free = [e for t in truths if len(t["effects"]) == 1 for e in t["effects"]
            if not e["capped"] and e["class"] != "saturation"]  # fmt: skip
    even = np.log([e["snr"] / 3 for e in free]) / np.log(10)
    assert even.min() >= 0 and even.max() <= 1
    assert abs(even.mean() - 0.5) < 4 / np.sqrt(12 * len(even))
    several = [t["effects"] for t in truths if len(t["effects"]) > 1]
    assert all(min(e["snr"] for e in s) >= 3 for s in several)
    assert all(len({e["class"] for e in s}) == len(s) for s in several)
    for effect in (e for t in truths for e in t["effects"]):
        assert trials.effect_of(effect).truth()["parameters"] == effect["parameters"]
    assert len({t["seed"] for t in truths}) == 500


def test_truths_are_sealed_before_they_are_diagnosed(calibration, tmp_path, monkeypatch):
    seen = []

    def diagnose(truth):
        path = tmp_path / "truths" / f"{truth['campaign']}.json"
        known = json.loads((tmp_path / "commitments.json").read_text())
        seen.append(known[truth["campaign"]] == digest(path))
        return report(campaign=truth["campaign"]), {"cpu_s": 1.0}

    monkeypatch.setattr(trials, "diagnose_trial", diagnose)
    opened = trials.take_trial(4, 5, tmp_path, calibration)
    assert seen == [True] and opened.commitment == digest(
        tmp_path / "truths/trial_0004.json"
    )
    trials.take_trial(4, 5, tmp_path, calibration)
    assert seen == [True]
    path = tmp_path / "truths" / "trial_0004.json"
    path.write_text(path.read_text().replace("0.", "1."))
    (tmp_path / "reports" / "trial_0004.json").unlink()
    with pytest.raises(
        ValueError, match=r"trial_0004.json: not the truth that was committed"
    ):
        trials.take_trial(4, 5, tmp_path, calibration)


def test_ended_at_any_moment_take_goes_on(calibration, tmp_path, monkeypatch):
    """Ended in the third diagnosis; what follows has the same truths, once each."""
    monkeypatch.setattr(trials, "read_amplitudes", lambda: calibration)
    monkeypatch.setattr(trials, "_own_snr", lambda *_: 7.0)
    made = []

    def diagnose(truth):
        if len(made) == 2 and "ended" not in made:
            made.append("ended")
            raise KeyboardInterrupt
        made.append(truth["campaign"])
        return report(campaign=truth["campaign"]), {"cpu_s": 1.0, "wall_s": 1.0}

    monkeypatch.setattr(trials, "diagnose_trial", diagnose)
    words = [
        "take",
        "--count",
        "5",
        "--work",
        str(tmp_path / "w"),
        "-o",
        str(tmp_path / "o.ecsv"),
    ]
    CliRunner().invoke(trials.main, words)
    sealed = (tmp_path / "w" / "truths" / "trial_0002.json").read_bytes()
    done = CliRunner().invoke(trials.main, words)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "w" / "truths" / "trial_0002.json").read_bytes() == sealed
    rows = read_rows(tmp_path / "o.ecsv")
    assert [r["campaign"] for r in rows] == [f"trial_{n:04d}" for n in range(5)]
    assert made == [
        "trial_0000",
        "trial_0001",
        "ended",
        *(f"trial_000{n}" for n in (2, 3, 4)),
    ]
    assert [from_row(r).cpu_s for r in rows] == [1.0] * 5
    shown = CliRunner().invoke(trials.main, ["show", "-o", str(tmp_path / "o.ecsv")])
    assert shown.exit_code == 0 and "Misses:" in shown.output
    other = CliRunner().invoke(trials.main, [*words, "--seed", "1"])
    assert other.exit_code == 1 and "seed.json: seed =" in other.output


def test_refusals(tmp_path):
    none = CliRunner().invoke(trials.main, ["show", "-o", str(tmp_path / "none.ecsv")])
    assert none.exit_code == 1 and "no rows of a set 'trials'" in none.output
    part = CliRunner().invoke(trials.main, ["take", "--part", "2/2"])
    assert part.exit_code == 2 and "K/N" in part.output


@pytest.fixture
def other_twins():
    """Twins of another size are not those of other tests."""
    amplitudes._fitted.cache_clear()
    yield
    amplitudes._fitted.cache_clear()


@pytest.mark.slow
def test_a_signal_grows_in_proportion_and_no_effect_has_none(monkeypatch, other_twins):
    """Twins of 192 x 192 pixels, four spots on each amplifier: about a minute.

    Twice the crosstalk is twice the projected SNR (measured power 1.001, here to 2 %), and
    a campaign with a neutral effect is its twin, bit for bit.
    """
    small = Size(192, 4, 1, dithers=1)
    source = amplitudes.VirtualSource
    monkeypatch.setattr(
        amplitudes, "VirtualSource", lambda **k: source(**(k | {"size": small}))
    )  # fmt: skip
    effect = make_effect("amp_crosstalk", {"c": 2e-3})
    one, two = (amplitudes.take_signal(effect.scaled(f)) for f in (0.5, 1.0))
    assert two.snr > 10 and "amp_cross" in two.shown
    assert two.snr / one.snr == pytest.approx(2.0, rel=0.02)
    assert not amplitudes.change(effect.neutral(), amplitudes.SEEDS[0]).any()


@pytest.mark.slow
@pytest.mark.parametrize("word", ["voltage_dependence", "cti_serial", "bf_chromatic"])
def test_amplitudes_on_record_are_those_of_the_channels_as_they_are(word):
    told = amplitudes.read_amplitudes()[word, ""]
    now = amplitudes.take_signal(strongest(word, "").scaled(told.high))
    assert now.snr == pytest.approx(told.snr_high, rel=0.1)
