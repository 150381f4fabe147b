"""Predictions for exposures that were not fitted, compared with those recorded."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.plan.forecast import Forecaster
from bfsensor.diagnose.plan.planned_exposures import Planned
from bfsensor.diagnose.plan.predict_conditions import (
    predict_conditions,
    read_conditions,
    refuse_unheld,
)
from bfsensor.effects.library import make_effect as candidate
from bfsensor.errors import DiagnosisError
from tests.measured import measure_once
from tests.virtual import SMALL, VirtualSource, make_effect, virtual_baseline

LAMP_ERROR = 2e-4


@pytest.fixture(scope="module")
def campaign():
    """A campaign with a curved response, and the flats and spots of it that were kept back."""
    source = VirtualSource(
        seed=7301,
        size=SMALL,
        effects=[make_effect("gain_nonlinearity", {"c2": -0.02, "c3": 0.0})],
        withheld=True,
    )
    kept, late = source.part(withheld=False), source.part(withheld=True)
    measured = measure_once(kept)
    predictor, fit = fit_bounded(measured, virtual_baseline())
    before = Model(predictor, fit)
    after = before.with_effects([candidate("gain_nonlinearity", {"c2": -0.01, "c3": 1e-3})])
    return before, after, late, measure_once(late)


def written(model, late, folder):
    """Predict the flats that were kept back, as the command does, and read the file."""
    flats = [e for e in late.exposures if e.kind == "flat"]
    biases = sorted({e.back_bias for e in flats})
    asked, lamps = [], {}
    for bias in biases:
        lamps[bias] = np.mean([e.lamp for e in flats if e.back_bias == bias])
        count = sum(e.back_bias == bias for e in flats)
        asked.append(f"seconds=40,back_bias={bias:g},lamp={lamps[bias]:.6f},count={count}")
    told = predict_conditions(model.predictor, model.fit, read_conditions(asked))
    rows = Table.read(told.write(folder / "predicted.ecsv"), format="ascii.ecsv")
    return rows


def chi2(rows, measured):
    """Deviations of what was recorded from what was written, by channel, over both errors."""
    out = {}
    for channel in measured.channels:
        if channel.word not in ("flat_cov", "flat_mean"):
            continue
        x = channel.axes
        for bias in np.unique(x["back_bias"]):
            own = x["back_bias"] == bias
            for row in rows[
                (rows["channel"] == channel.word) & (rows["back_bias"] == bias)
            ]:
                here = own & (x["amp"] == int(row["amp"].split()[-1]))
                if channel.word == "flat_cov":
                    here &= (x["i"] == row["i"]) & (x["j"] == row["j"])
                weight = x["pairs"][here] if "pairs" in x else np.ones(here.sum())
                key = channel.word, float(bias), row["amp"], row["i"], row["j"]
                out.setdefault(key, []).append((channel.values[here], weight, row))
    square = {"flat_cov": [], "flat_mean": []}
    for (word, *_), parts in out.items():
        values, weights = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
        row = parts[0][2]
        away = np.average(values, weights=weights) - row["value"]
        square[word].append(away / np.hypot(row["error"], row["noise"]))
    return {w: np.array(v) for w, v in square.items()}


def test_kept_back_flats_are_as_predicted_with_the_effect_and_not_without(
    campaign, tmp_path
):
    before, after, late, measured = campaign
    with_effect = chi2(written(after, late, tmp_path), measured)
    without = chi2(written(before, late, tmp_path), measured)
    assert len(with_effect["flat_cov"]) == 100 and len(with_effect["flat_mean"]) == 4
    # 100 values scatter by 0.14 about 1; the four means share two lamps.
    assert 0.6 < np.mean(with_effect["flat_cov"] ** 2) < 1.42
    assert np.mean(with_effect["flat_mean"] ** 2) < 4
    assert np.mean(without["flat_mean"] ** 2) > 30


def test_errors_come_from_the_parameters_covariance(campaign, tmp_path):
    """Drawn parameters scatter predictions by the errors that are written."""
    after = campaign[1]
    told = predict_conditions(
        after.predictor,
        after.fit,
        read_conditions(["seconds=40,back_bias=-40", "flux=6e5"]),
    )
    rows = told.rows()
    assert {r["what"] for r in rows} == {"mean", "covariance", "sigma_x", "sigma_y", "flux"}
    fit = after.fit
    rng = np.random.default_rng(17)
    # Unlike singular vectors, whose signs differ from machine to machine, this root is one.
    root = np.linalg.cholesky(fit.covariance / np.outer(fit.errors, fit.errors))
    draws = rng.standard_normal((200, len(fit.errors))) @ root.T
    count = len(after.predictor.names)
    for _, one in told.forecasts:
        if one.channel.word != "flat_cov":
            continue
        here = after.predictor.predict(one.channel, fit.values[:count])
        seen = [
            after.predictor.predict(
                one.channel, fit.values[:count] + (d * fit.errors)[:count]
            )
            - here
            for d in draws
        ]
        errors = np.sqrt(np.diag(one.covariance(fit)))
        variance = one.channel.axes["i"] + one.channel.axes["j"] == 0
        ratio = np.std(seen, axis=0)[variance] / errors[variance]
        # 200 draws give a width to 5 %.
        assert (np.abs(ratio - 1) < 0.2).all(), ratio


def test_temperatures_are_asked_for_in_celsius():
    one, other = read_conditions(["level=4e4,temperature=-80", "level=4e4"])
    assert one.temperature == 193.15 and np.isnan(other.temperature)
    baseline = virtual_baseline()
    with pytest.raises(
        DiagnosisError, match="back_bias=-10, temperature=-80: the baseline"
    ):
        refuse_unheld(
            read_conditions(["level=4e4,back_bias=-10,temperature=-80"]), baseline
        )


def test_spots_of_other_fluxes_grow_as_recorded(campaign):
    """Predicted widths lie between those recorded at fluxes around them."""
    after = campaign[1]
    told = predict_conditions(
        after.predictor, after.fit, read_conditions(["flux=2e5", "flux=6e5", "flux=1e6"])
    )
    width = [r["value"] for r in told.rows() if r["what"] == "sigma_y"]
    like = next(c for c in after.fit.channels if c.word == "spot")
    x = like.axes
    own = (x["what"] == "sigma_y") & (x["wavelength"] == 620) & (x["back_bias"] == -60)
    own &= x["temperature"] == 173.15
    # What is written for the user is in deg C, as the campaign's headers are.
    assert {r["temperature"] for r in told.rows()} == {-100.0}
    line = np.polyfit(x["flux"][own], like.values[own], 2)
    assert np.diff(width).min() > 0
    assert np.polyval(line, [2e5, 6e5, 1e6]) == pytest.approx(width, abs=2e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colour=3", "colour must be one of kind, level"),
        ("level", "not NAME=VALUE"),
        ("level=many", "level=many is not a finite number"),
        ("wavelength=480", "flats need level or seconds"),
        ("seconds=-3", "must be above 0"),
        ("kind=moon,seconds=3", "kind=moon must be flat or spot"),
        ("nowhere.ecsv", "nowhere.ecsv: not an ECSV table"),
    ],
)
def test_conditions_that_are_none(text, message):
    with pytest.raises(DiagnosisError, match=message):
        read_conditions([text])


def test_a_file_of_conditions(tmp_path):
    path = tmp_path / "conditions.ecsv"
    Table({"level": [4e4, 8e4], "back_bias": [-60.0, -40.0]}).write(path)
    found = read_conditions([str(path)])
    assert [(p.kind, p.level, p.back_bias) for p in found] == [
        ("flat", 4e4, -60.0), ("flat", 8e4, -40.0)
    ]  # fmt: skip


def test_conditions_that_the_baseline_does_not_hold():
    planned = read_conditions(["level=40000,wavelength=750,back_bias=-50"])
    with pytest.raises(DiagnosisError, match="wavelength=750, back_bias=-50: the baseline"):
        refuse_unheld(planned, virtual_baseline())
    refuse_unheld(
        read_conditions(["level=40000,wavelength=480,back_bias=-60"]), virtual_baseline()
    )


def test_planned_exposures_have_the_error_of_the_campaigns_own_lamp(campaign):
    """A planned mean scatters by the monitor's stated error, whatever the campaign's is."""
    before, *_ = campaign
    planned = Planned("flat", 1, level=4e4)
    found = {}
    for error in (1e-4, 1e-3):
        predictor = copy(before.predictor)
        predictor.measured = replace(predictor.measured, lamp_error=error)
        told = Forecaster(predictor, before.fit).forecasts([planned])
        mean = next(f.channel for f in told if f.channel.word == "flat_mean")
        found[error] = mean.blocks[0][0, 0], mean.values[0]
    (less, level), (more, _) = found[1e-4], found[1e-3]
    assert more - less == pytest.approx((1e-6 - 1e-8) * level**2, rel=1e-2)
