"""Small campaigns of the virtual sensor, diagnosed: a null, and effects in four channels."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.diagnose import diagnosis
from bfsensor.diagnose.detect.locate import Scanner, locate_mismatch, tail_probability
from bfsensor.diagnose.detect.scans import DEVICE_SCAN
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.report.diagnosis_result import SCHEMA
from bfsensor.diagnose.report.html_report import write_report
from bfsensor.errors import ConvergenceError
from tests.virtual import (
    fit_virtual,
    make_effect,
    measure_virtual,
    virtual_baseline,
    write_campaign,
)


def run(seed, *effects):
    measured = measure_virtual(seed=seed, effects=effects)
    return diagnose_measured(
        measured, virtual_baseline(), campaign=f"small {seed}", explain=False
    )


@pytest.fixture(scope="module")
def null():
    return run(7001)


def test_a_null_is_a_null(null):
    assert not null.mismatch.detected
    assert null.mismatch.p_value > 0.01
    assert all(not v for v in null.location().values())
    assert 0.9 < null.heldout < 1.1
    for word, (square, dof) in null.mismatch.chi2.items():
        assert square < dof + 5 * np.sqrt(2 * dof) + 5, word
    assert "Nothing stands out" in null.said()


def test_gains_and_device_come_back(null):
    assert (np.abs(list(null.fit.pulls.values())) < 4).all()
    names = list(null.fit.names)
    gains = [null.fit.values[names.index(f"gain {n}")] for n in (0, 1)]
    assert min(gains) > 1.8 and max(gains) < 2.7


def test_draws_give_unit_deviates(null):
    scanner = Scanner(null.fit)
    z = scanner.templates_z(null.fit.draw(np.random.default_rng(5), 400))
    width = z.std(0)
    assert abs(width.mean() - 1) < 0.01 and abs(z.mean()) < 0.01
    c = scanner.chi2_z(null.fit.draw(np.random.default_rng(6), 400))
    assert (np.abs(c.mean(0)) < 0.35).all() and (np.abs(c.std(0) - 1) < 0.35).all()


def test_family_wise_p_is_what_it_claims(null):
    """Noise drawn through the fit, diagnosed as if it were recorded."""
    scanner = Scanner(null.fit)
    draw = null.fit.draw(np.random.default_rng(8), 900)
    largest = np.maximum(
        np.abs(scanner.templates_z(draw)).max(1), scanner.chi2_z(draw).max(1)
    )
    p = np.array([tail_probability(v, largest[:500]) for v in largest[500:]])
    assert abs((p < 0.05).mean() - 0.05) < 0.04
    assert (p < 0.01).mean() < 0.035


@pytest.mark.parametrize(
    ("word", "parameters", "channel"),
    [
        ("cti_serial", {"cti": 2e-6}, "serial_overscan"),
        ("gain_nonlinearity", {"c2": -0.01, "c3": 0.0}, "flat_mean"),
        ("electronic_memory", {"alpha": 1e-3}, "serial_overscan"),
        ("mask_stitch", {"amp": 0.02, "period": 32.0}, "flat_map"),
    ],
)
def test_effects_are_seen_where_they_are(word, parameters, channel):
    found = run(7002, make_effect(word, parameters))
    assert found.mismatch.detected
    assert found.mismatch.p_value < 1e-4
    assert channel in found.location()["channels"]
    assert found.mismatch.findings[0].word == channel


def test_the_report_has_what_programs_rely_on(null, tmp_path):
    written = write_report(null, tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["schema"] == SCHEMA == "bfsensor-diagnosis-1"
    for key in ("campaign", "version", "detected", "p_value", "effects", "class_probability",
                "equivalence_class", "open_world", "location", "recommended_recordings",
                "heldout", "said"):  # fmt: skip
        assert key in report
    assert set(report["location"]) == {
        "channels", "lags", "flux_e", "x", "y", "amps", "wavelength", "exposures",
    }  # fmt: skip
    text = (tmp_path / "out" / "report.html").read_text()
    assert text.count("<img") >= 6 and "Nothing stands out" in text
    assert all(p.exists() for p in written)
    assert not list((tmp_path / "out").glob("*.tmp*"))


def test_the_same_seed_gives_the_same_p(null):
    assert (
        locate_mismatch(null.fit, seed=4).p_value
        == locate_mismatch(null.fit, seed=4).p_value
    )


def test_the_command_diagnoses_a_folder(tmp_path):
    folder = tmp_path / "campaign"
    write_campaign(
        folder, seed=7003, size="T", effects=[make_effect("cti_serial", {"cti": 4e-6})]
    )
    out = tmp_path / "out"
    asked = ["--predict", "seconds=40,back_bias=-40", "--predict", "flux=5e5"]
    # The golden cases run the command with the search for effects.
    words = ["diagnose", str(folder), "-o", str(out), "--locate-only", *asked]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert "serial overscan" in result.stdout
    report = json.loads((out / "report.json").read_text())
    assert report["detected"] and "serial_overscan" in report["location"]["channels"]
    told = Table.read(out / "predicted.ecsv", format="ascii.ecsv")
    assert set(told["what"]) == {"mean", "covariance", "sigma_x", "sigma_y", "flux"}
    assert (told["error"] >= 0).all() and (told["noise"] > 0).all()
    unheld = ["diagnose", str(folder), "--predict", "level=4e4,wavelength=750"]
    refused = CliRunner().invoke(main, unheld)
    assert refused.exit_code == 1 and "wavelength=750: the baseline" in refused.stderr
    again = CliRunner().invoke(main, ["diagnose", str(tmp_path / "nowhere")])
    assert again.exit_code == 1 and "nowhere" in again.stderr
    none = CliRunner().invoke(main, ["diagnose", str(folder), "--baseline", "nothing"])
    assert none.exit_code == 1 and "nothing: not a baseline" in none.stderr


@pytest.mark.slow
def test_a_device_far_from_nominal_is_reported_and_not_absorbed(tmp_path):
    """A parameter that the fit moves far from its nominal value is a finding, in words too."""
    measured, predictor, fit = fit_virtual(seed=8112)
    point = fit.values[: len(predictor.names)]
    moved = point.copy()
    moved[predictor.names.index("device h")] += 8.0
    channels = tuple(
        replace(c, values=c.values + predictor.predict(c, moved) - predictor.predict(c, point))
        for c in measured.channels
    )  # fmt: skip
    found = diagnose_measured(replace(measured, channels=channels), virtual_baseline())
    assert found.mismatch.detected
    assert any(f.family == DEVICE_SCAN for f in found.mismatch.findings)
    report = found.to_report()
    assert "device_parameter" in report["equivalence_class"]
    assert set(report["location"]["channels"]) <= {c.word for c in found.fit.channels}
    assert "device" in report["said"]
    write_report(found, tmp_path)


def explained(total, *names):
    """Attribution with effects of these names and this chi-square."""
    return SimpleNamespace(
        found=tuple(SimpleNamespace(effect=SimpleNamespace(name=n)) for n in names),
        fit=SimpleNamespace(total=total),
    )


@pytest.mark.parametrize(
    ("again", "taken"),
    [
        (explained(90.0, "electronic_memory"), True),
        (explained(110.0, "electronic_memory"), False),
        (explained(80.0, "electronic_memory", "device_parameter"), False),
    ],
)
def test_a_device_is_solved_beside_what_is_found(monkeypatch, again, taken):
    asked = []
    monkeypatch.setattr(
        diagnosis, "_expanded", lambda baseline, fit: asked.append(fit) or baseline
    )
    monkeypatch.setattr(diagnosis, "fit_bounded", lambda measured, baseline: (None, None))
    monkeypatch.setattr(
        diagnosis, "locate_effects", lambda *_, seed: SimpleNamespace(detected=True)
    )
    monkeypatch.setattr(diagnosis, "_explained", lambda *_: again)
    first = explained(100.0, "electronic_memory")
    found = diagnosis._solved_beside(None, "baseline", first, 1)
    assert found is (again if taken else first)
    assert asked == [first.fit]


def test_a_device_that_cannot_be_solved_there_leaves_the_explanation(monkeypatch):
    monkeypatch.setattr(diagnosis, "_expanded", lambda *_: None)
    first = explained(100.0, "electronic_memory")
    assert diagnosis._solved_beside(None, None, first, 1) is first


def test_an_explanation_is_kept_where_the_search_beside_it_does_not_converge(monkeypatch):
    def fails(*_, **__):
        raise ConvergenceError("no", [])

    monkeypatch.setattr(diagnosis, "_expanded", lambda *_: "baseline")
    monkeypatch.setattr(diagnosis, "fit_bounded", fails)
    first = explained(100.0, "electronic_memory")
    assert diagnosis._solved_beside(None, "baseline", first, 1) is first
