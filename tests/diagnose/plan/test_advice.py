"""Plans: expected chi-squares against least squares, rules against pixels, and a tie broken."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.diagnose.plan.advice import ENOUGH, plan
from bfsensor.diagnose.plan.catalogue import RULES, make_recordings
from bfsensor.diagnose.plan.forecast import Forecaster
from bfsensor.diagnose.plan.gaps import ALWAYS, NEEDS, find_untested
from bfsensor.diagnose.plan.planned_exposures import Forecast, Information, Planned
from bfsensor.errors import ConvergenceError
from tests.diagnose.conftest import TIED_SEED
from tests.measured import measure_once
from tests.virtual import (
    KNOWN,
    Size,
    VirtualSource,
    make_effect,
    virtual_baseline,
)

BINNED = Size(128, 2, 0, dithers=0, flat_seconds=(3.0, 9.0, 18.0, 27.0))
"""The recipe of binned flats: 16 exposures of 6,000 to 54,000 e- in each pixel."""


class Binning:
    """Two columns are summed on the output node, behind all transfers."""

    def __getattr__(self, name):
        nothing = {"device": lambda d: d, "shifts": lambda s, c: s, "gain": lambda c: 1.0,
                   "displaced": lambda c: None, "light": lambda s, c: None}  # fmt: skip
        if name in ("laws", "spot_light"):
            return lambda c: {}
        return nothing.get(name, lambda frames, c: frames)

    def shift(self, frames, context):
        return [bin_columns(f) for f in frames]


def bin_columns(frame):
    return frame[:, ::2] + frame[:, 1::2]


def binned_source(seed, *effects):
    """Flats of the virtual sensor, read with two columns in one."""
    source = VirtualSource(seed=seed, size=BINNED, effects=[*effects, Binning()])
    whole = source._geometry
    source._geometry = SimpleNamespace(
        pixels=whole.pixels, width=whole.width // 2, prescan=whole.prescan // 2,
        serial_overscan=whole.serial_overscan // 2, parallel_overscan=whole.parallel_overscan,
    )  # fmt: skip
    source.shape = whole.pixels, whole.pixels // 2
    return source


def held_against(measured, effect):
    """Chi-square of the means of flats with an effect as it is, the light fitted."""
    predictor = Predictor(measured, virtual_baseline(), [effect])
    square = number = 0
    for channel in measured.channels:
        if channel.word == "flat_mean":
            left = channel.whiten(
                channel.values - predictor.predict(channel, predictor.start)
            )
            columns = predictor.linear(channel)
            light = [channel.whiten(c) for n, c in columns.items() if n.startswith("light")]
            found = np.linalg.lstsq(np.array(light).T, left, rcond=None)[0]
            left = left - np.array(light).T @ found
            square += left @ left
            number += len(left) - len(light)
    return square, number


@pytest.fixture(scope="module")
def planned(tied):
    return plan(tied)


def test_information_is_that_of_least_squares_of_all_there_is():
    """Old recordings, new ones, their free light: one fit of all, with the wrong model."""
    rng = np.random.default_rng(3)
    old, new, light = (
        rng.normal(size=(40, 5)),
        rng.normal(size=(12, 5)),
        rng.normal(size=12),
    )
    errors = rng.uniform(0.5, 2.0, 12)
    away = 3 * rng.normal(size=12)
    covariance = np.linalg.inv(old.T @ old)
    whole = np.zeros((52, 6))
    whole[:40, :5], whole[40:, :5] = old, new / errors[:, None]
    whole[40:, 5] = light / errors
    target = np.concatenate([np.zeros(40), away / errors])
    found = np.linalg.lstsq(whole, target, rcond=None)[0]
    expected = ((target - whole @ found) ** 2).sum()
    blocks = tuple(np.array([[e**2]]) for e in errors)
    forecasts = [
        Forecast(
            Channel("flat_cov", values, blocks, {"k": np.arange(12)}, "adu2"),
            new,
            {"light": light},
        )
        for values in (away, np.zeros(12))
    ]
    fit = SimpleNamespace(covariance=covariance, names=tuple("abcde"))
    told = Information([forecasts[0]], [forecasts[1]], fit)
    assert told.delta_chi2() == pytest.approx(expected, rel=1e-9)
    # Parameters that are known better leave less room.
    fit.covariance = 1e-9 * covariance
    assert Information([forecasts[0]], [forecasts[1]], fit).delta_chi2() > expected


def test_the_twins_are_tied_and_the_plan_is_one_recording(tied, planned):
    assert set(tied.tied) == {"charge_loss", "gain_nonlinearity"}
    (advice,) = planned.advised
    assert advice.recording.name == "binned_serial" and advice.exposures == 16
    assert advice.decides and "binned by two along the row" in planned.said()[0]
    block = planned.to_report()[0]
    assert set(block["separates"]) == set(tied.tied)
    assert block["expected_delta_chi2"] > ENOUGH
    assert sum(r["count"] for r in block["recipe"]) == block["exposures"]
    # An effect of the level alone is not separated better by another light.
    rest = {n: v for n, _, v in block_others(block)}
    assert "light_rate" not in rest or rest["light_rate"] < ENOUGH


def block_others(block):
    return [
        (o["recording"], o["exposures"], o["expected_delta_chi2"]) for o in block["others"]
    ]


def test_the_advised_recording_breaks_the_tie(tied, planned):
    """Binned flats of either truth: each fit as it was, loss with the charge, half of the signal."""
    (found,) = tied.found
    rivals = {r.word: r.effect for r in found.rivals}
    rivals[found.effect.word] = found.effect
    rule = RULES["binned_serial"]
    expected = planned.advised[0].expected
    truths = (
        make_effect("charge_loss", {"q": 1.5e-7}),
        make_effect("gain_nonlinearity", dict(rivals["gain_nonlinearity"].values)),
    )
    for truth in truths:
        # The same chip.  Variance over mean of binned pixels is no gain: it is known by now.
        measured = replace(
            measure_once(binned_source(TIED_SEED, truth)), gains=tuple(tied.fit.values[:2])
        )
        square = {}
        for word, effect in rivals.items():
            keeps = rule.of(word)
            square[word], number = held_against(measured, effect.scaled(keeps))
        wrong = next(w for w in square if w != truth.word)
        assert square[truth.word] < number + 5 * np.sqrt(2 * number)
        gained = square[wrong] - square[truth.word]
        assert gained > ENOUGH
        # The rule is an estimate; amplitudes do not give way here.
        assert 0.4 < gained / expected < 6


def frame(columns=64, prescan=8, overscan=24, signal=5e4):
    out = np.zeros((4, prescan + columns + overscan), np.float32)
    out[:, prescan : prescan + columns] = signal
    return out


@pytest.mark.parametrize(
    ("word", "parameters"),
    [("cti_serial", {"cti": 2e-6}), ("electronic_memory", {"alpha": 1e-3})],
)
def test_rules_are_what_pixels_do(word, parameters):
    """Behind flats of equal signal: binned, and lit halfway only."""
    effect = make_effect(word, parameters)
    signal = 5e4

    def read(charge, binned):
        frames = effect.shift([charge], None)
        frames = [bin_columns(f) for f in frames] if binned else frames
        return effect.amplifier(frames, None)[0]

    plain = float(read(frame(signal=signal), False)[:, 72].mean())
    summed = float(read(frame(signal=signal / 2), True)[:, 36].mean())
    half = frame(signal=signal)
    half[:, 8 + 32 :] = 0
    near = float(read(half, False)[:, 8 + 32].mean())
    assert summed / plain == pytest.approx(RULES["binned_serial"].of(word), rel=0.02)
    # Prescan: 40 of 72 transfers, not half.
    wanted = RULES["near_columns"].of(word)
    assert near / plain == pytest.approx(1.0 if wanted == 1 else wanted * 80 / 72, rel=0.02)


def test_exposures_are_predicted_with_their_noise(tied):
    """Errors of planned flats are those of recorded ones of as many exposures."""
    here = Forecaster(tied.predictor, tied.fit)
    made = here.forecasts([Planned("flat", 4, seconds=40.0)])
    for word in ("flat_cov", "flat_mean", "serial_overscan"):
        (one,) = (f.channel for f in made if f.channel.word == word)
        like = next(c for c in tied.fit.channels if c.word == word)
        x = like.axes
        rows = (x["time"] == 40.0) & (x["back_bias"] == -60) & (x["wavelength"] == 620)
        # Means are recorded one by one, two pairs of four are in this fold.
        times = {"flat_mean": 4, "flat_cov": 1, "serial_overscan": 1}[word]
        recorded = like.errors[rows][: len(one)]
        ratio = one.errors[: len(recorded)] / (recorded / np.sqrt(times))
        assert (np.abs(ratio - 1) < 0.1).all(), word


def test_nothing_tied_nothing_planned(tied):
    alone = replace(tied, found=tuple(replace(f, tied=f.tied[:1]) for f in tied.found))
    assert not plan(alone).advised and plan(alone).said() == []


@pytest.mark.slow
def test_no_recording_is_advised_where_effects_take_little(tied):
    shares = {"effects": 0.3, "laws": 0.1, "outside": 0.1, "left": 0.5}
    none = plan(replace(tied, shares=shares))
    assert not none.advised and "effects take 40 %" in none.notes[0]
    assert plan(replace(tied, shares=shares | {"effects": 0.5, "left": 0.3})).advised


def test_what_a_rival_cannot_predict_is_noted(tied, monkeypatch):
    def full(self, forecasts, other):
        raise ConvergenceError("widths of spots still move", [])

    monkeypatch.setattr(Forecaster, "same", full)
    notes = [n for n in plan(tied).notes if n.startswith("no forecast of")]
    assert notes and all("widths of spots still move" in n for n in notes)


def test_what_the_accepted_fit_cannot_predict_is_noted(tied, monkeypatch):
    forecasts = Forecaster.forecasts

    def full(self, planned):
        if any(p.kind == "spot" for p in planned):
            raise ConvergenceError("wells are full", [])
        return forecasts(self, planned)

    monkeypatch.setattr(Forecaster, "forecasts", full)
    notes = [n for n in plan(tied).notes if "wells are full" in n]
    assert notes and all(n.startswith("no forecast of") for n in notes)


def test_recordings_cover_what_the_design_names(tied):
    here = Forecaster(tied.predictor, tied.fit)
    made = make_recordings(here.usual, here.brightest, here.brightest_spot)
    names = [r.name for r in made]
    assert len(set(names)) == len(names) and set(RULES) <= set(names)
    assert all(r.exposures > 0 for r in made if not r.again)
    known = {*KNOWN, "silicon_physics", "outside_library"}
    for rule in RULES.values():
        assert set(rule.keeps) <= known and rule.why and rule.source


def test_what_cannot_be_seen_is_told(tied):
    measured = tied.predictor.measured
    assert set(NEEDS) == {*KNOWN, "silicon_physics"}
    assert find_untested(measured) == ALWAYS
    kept = tuple(c for c in measured.channels if c.word not in ("serial_overscan", "spot"))
    less = replace(measured, channels=kept, lamp_known=False)
    told = {u.word: u for u in find_untested(less)}
    assert {"cti_serial", "lateral_diffusion", "charge_loss"} <= set(told)
    assert "tree_rings" not in told and "bf_chromatic" not in told
    assert told["charge_loss"].because == "no lamp monitor"
    red = [c for c in measured.channels if c.word == "flat_cov"]
    one = tuple(
        replace(c, axes={**c.axes, "wavelength": np.full(len(c), 620.0)})
        for c in red
    )  # fmt: skip
    (told_,) = (
        u
        for u in find_untested(replace(measured, channels=one))
        if u.word == "bf_chromatic"
    )
    assert told_.because == "one wavelength (620 nm)"
