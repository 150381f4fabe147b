"""The quantity of a device that recordings place farthest from its file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bfsensor.diagnose import diagnose_measured, measure_reduced
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.report.device_words import fitted_quantities, said_farthest
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.response.edge_response import area_matrix

KEY = (620.0, -60.0)
N = 3
NAMES = "silicon.background_doping", "silicon.thickness", "gates.gate_oxide"


def shifts():
    """Shifts of a charge with reflections, and changes of them in three ways."""
    at = np.arange(-N, N + 1)
    x, y = np.meshgrid(at + 0.5, at)
    kx = -1e-7 * np.sign(x) / (np.abs(x) + y**2) ** 2
    near = np.where(np.abs(x) < 1, kx, 0.0)
    return (kx, 1.5 * kx.T), ((kx, kx.T), (near, 0 * near), (near, near.T))


@pytest.fixture
def baseline():
    edges, changes = shifts()
    return Baseline(
        "thick", {KEY: edges}, dict(zip(NAMES, changes, strict=True)),
        dict.fromkeys(NAMES, 0.01), KEY, nominal=dict.fromkeys(NAMES, 1.0),
        units=dict.fromkeys(NAMES, "um"), bounds=dict.fromkeys(NAMES, (-0.2, 0.2)),
    )  # fmt: skip


def table(change, seed=1):
    edges, changes = shifts()
    kx, ky = (e + sum(v * c[n] for v, c in zip(change, changes, strict=True))
              for n, e in enumerate(edges))  # fmt: skip
    a = area_matrix(kx, ky)
    middle = len(a) // 2
    a = a[middle : middle + N, middle : middle + N]
    errors = np.full(a.shape, 1e-10)
    noise = errors * np.random.default_rng(seed).standard_normal(a.shape)
    return AreaChangeTable(Path("made"), a + noise, errors, np.ones(a.shape, bool))


def test_gain_is_that_of_leaving_out_the_prior(baseline):
    measured = measure_reduced(table((0.03, 0.0, 0.0)), reach=baseline.reach)
    predictor, fit = fit_bounded(measured, baseline)
    found = fitted_quantities(fit, predictor.baseline)
    assert found[0].name == NAMES[0]
    for q in found:
        free = replace(baseline, spread={**baseline.spread, q.name: 1e4 * 0.01})
        without = fit_bounded(measured, free)[1]
        assert q.gain == pytest.approx(fit.total - without.total, rel=1e-3, abs=1e-6)
        pull = without.pulls[q.name] * 1e4
        assert q.alone == pytest.approx(1 + 0.01 * pull, rel=1e-5)


def test_farthest_quantity_is_said_in_its_unit_whether_or_not_there_is_an_alarm(baseline):
    measured = measure_reduced(table((0.03, 0.0, 0.0)), reach=baseline.reach)
    result = diagnose_measured(measured, baseline, explain=False)
    said = result.said()
    assert "background doping (silicon.background_doping) is 1.03 +- " in said
    assert "um by the recordings, nominally 1 um;" in said and "times as likely" in said
    first = json.loads(json.dumps(result.to_report()))["device"][0]
    assert first["at_end"] is False
    assert first["value"] == pytest.approx(1.03, abs=0.003) and first["nominal"] == 1.0


def test_value_that_cannot_be_is_not_stated(baseline):
    """A quantity that would explain the rest far beyond its range gains less by it."""
    weak = {n: tuple(0.002 * k for k in d) for n, d in baseline.derivatives.items()}
    weak |= {NAMES[1]: baseline.derivatives[NAMES[1]]}
    measured = measure_reduced(table((0.001, 0.0, 0.0)), reach=baseline.reach)
    narrow = replace(baseline, derivatives=weak)
    predictor, fit = fit_bounded(measured, narrow)
    found = {q.name: q for q in fitted_quantities(fit, predictor.baseline)}[NAMES[0]]
    assert found.pull_error > 0.9 and found.alone == pytest.approx(1 + 16 * 0.01)
    assert 0 < found.gain < found.pull**2 / (1 - found.pull_error**2)
    assert found.at_end and "an end of what is taken as possible" in said_farthest([found])


def test_device_within_its_file_is_not_said(baseline):
    measured = measure_reduced(table((0.005, -0.01, 0.004)), reach=baseline.reach)
    assert "Farthest" not in diagnose_measured(measured, baseline, explain=False).said()


def test_errors_of_the_calculation_are_no_quantities(baseline):
    measured = measure_reduced(table((0.03, 0.0, 0.0)), reach=baseline.reach)
    numeric = replace(baseline, accuracy=NAMES[:1])
    predictor, fit = fit_bounded(measured, numeric)
    assert NAMES[0] not in [q.name for q in fitted_quantities(fit, predictor.baseline)]
    assert said_farthest([]) == ""


def test_quantities_that_are_not_separated_are_named(baseline):
    alike = replace(
        baseline,
        derivatives={**baseline.derivatives, NAMES[1]: baseline.derivatives[NAMES[0]]},
    )
    measured = measure_reduced(table((0.08, 0.0, 0.0)), reach=baseline.reach)
    predictor, fit = fit_bounded(measured, alike)
    said = said_farthest(fitted_quantities(fit, predictor.baseline))
    first, other = said.split("in its place: ")
    assert {n for n in NAMES[:2] if n in first} | {other.strip(".")} == set(NAMES[:2])


def test_a_quantity_at_an_end_of_0_is_0(baseline):
    """Not the round-off of its nominal value less all of it."""
    name = NAMES[0]
    whole = replace(
        baseline, nominal={**baseline.nominal, name: 1.8}, bounds={**baseline.bounds, name: (-1.8, 1.0)},
        spread={**baseline.spread, name: 0.3},
    )  # fmt: skip
    measured = measure_reduced(table((-2.5, 0.0, 0.0)), reach=baseline.reach)
    predictor, fit = fit_bounded(measured, whole)
    (found,) = (q for q in fitted_quantities(fit, predictor.baseline) if q.name == name)
    assert found.at_end and found.alone == 0.0
