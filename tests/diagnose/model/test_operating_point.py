"""Another operating point of the same device as a candidate, and plans for reduced recordings."""

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.explain.attribution import Found
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.model.table_baseline import (
    BACK_BIAS,
    baseline_of_table,
    with_operating_point,
)
from bfsensor.diagnose.plan.advice import ruled
from bfsensor.diagnose.plan.catalogue import RULES, Recording
from bfsensor.diagnose.plan.forecast import Forecaster
from bfsensor.diagnose.plan.planned_exposures import Planned
from bfsensor.effects.library import make_effect
from bfsensor.errors import DiagnosisError
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.response.edge_response import area_matrix


def recorded(name, *, seed, error=2.5e-9):
    """a_ij as a table of ours has them on 40,000 e-, with noise: those of the E2V recording's size."""
    baseline = baseline_of_table(name)
    plane = baseline.areas_on(Condition(), None, 40_000.0)
    n = len(plane) // 2
    a = plane[n : n + 5, n : n + 5]
    rng = np.random.default_rng(seed)
    independent = np.ones((5, 5), bool)
    independent[0, 0] = False
    return AreaChangeTable(
        Path(f"drawn {seed}"),
        a + error * rng.standard_normal(a.shape),
        np.full((5, 5), error),
        independent,
    )


@pytest.mark.parametrize("seed", [5107, 5108])
def test_the_other_operating_point_is_named_with_its_back_bias(seed):
    baseline = with_operating_point("e2v_ccd250", "e2v_ccd250_70")
    table = recorded("e2v_ccd250_70", seed=seed)
    found = diagnose_measured(measure_reduced(table, reach=4), baseline)
    (one, *_) = found.attribution.found
    assert one.effect.name == f"device_parameter:{BACK_BIAS}"
    # Backgrounds act a little otherwise at the two: a volt of the line between them.
    assert abs(one.effect[BACK_BIAS] + 70.0) < 4 * one.errors[BACK_BIAS] + 1.0
    assert len(found.attribution.found) == 1
    assert f"back bias = {one.effect[BACK_BIAS]:.3g}" in found.said()
    # Recorded at the nominal back bias there is nothing to name.
    table = recorded("e2v_ccd250", seed=seed)
    found = diagnose_measured(measure_reduced(table, reach=4), baseline)
    assert not found.mismatch.detected


def test_without_the_candidate_the_operating_point_is_not_named():
    baseline = with_operating_point("e2v_ccd250", "e2v_ccd250_70").without([BACK_BIAS])
    table = recorded("e2v_ccd250_70", seed=5109)
    found = diagnose_measured(measure_reduced(table, reach=4), baseline)
    assert found.mismatch.detected and "back_bias" not in found.said()


@pytest.mark.parametrize("name", ["e2v_ccd250_70", "itl_sta3800c_60"])
def test_a_transposed_table_is_named_as_a_whole_exchange(name):
    """The change of the response with the background is exchanged with it."""
    table = recorded(name, seed=5111)
    turned = AreaChangeTable(table.path, table.a.T, table.errors.T, table.independent.T)
    found = diagnose_measured(measure_reduced(turned, reach=4), baseline_of_table(name))
    (one,) = found.attribution.found
    assert one.effect.name == "outside_library:axes_exchanged"
    # A wrong size of 0.89 was 6 standard deviations off where the background's part stayed.
    assert abs(one.effect["amp"] - 1.0) < 3 * one.errors["amp"]
    assert f"{one.effect['amp']:.2f} +- {one.errors['amp']:.2f}" in found.said()
    assert not found.attribution.mismatch.detected


def test_line_ends_at_the_other_table():
    line = with_operating_point("itl_sta3800c", "itl_sta3800c_60")
    moved, _ = line.at(Condition(), {BACK_BIAS: -10.0})
    other = baseline_of_table("itl_sta3800c_60")
    np.testing.assert_allclose(
        area_matrix(*moved), area_matrix(*other.edges[other.reference]), atol=1e-16
    )


def test_two_devices_are_refused():
    with pytest.raises(DiagnosisError, match="not of one device at two operating points"):
        with_operating_point("e2v_ccd250", "itl_sta3800c")
    with pytest.raises(DiagnosisError, match="not of one device at two operating points"):
        with_operating_point("lsst_e2v_50_8", "lsst_e2v_8")
    with pytest.raises(DiagnosisError, match="must differ in the first alone"):
        with_operating_point("e2v_ccd250", "e2v_ccd250")


def test_reduced_recordings_tell_no_clouds_and_no_darks():
    """Neither pixels nor noise are known: Fe55 promises nothing instead of dividing by 0."""
    table = recorded("e2v_ccd250_70", seed=5110)
    predictor, fit = fit_bounded(
        measure_reduced(table, reach=4), baseline_of_table("e2v_ccd250")
    )
    here = Forecaster(predictor, fit)
    coupling = make_effect("interpixel_coupling", {"ax": 1e-3, "ay": 1e-3})
    loss = make_effect("charge_loss", {"q": 1e-7})
    template = np.ones(len(fit.residuals))
    found = Found(coupling, 9.0, {}, {}, ("interpixel_coupling", "charge_loss"))
    fe55 = Recording("fe55", "Fe55", (Planned("dark", 50, seconds=60.0),), RULES["fe55"])
    assert ruled(fe55, here, found, Rival(loss, 8.0, 3.0, template)) == 0.0
    assert here.forecasts((Planned("dark", 10, seconds=15.0, after=1e5),)) == []


def test_areas_without_a_level_tell_no_response_to_it():
    baseline = baseline_of_table("e2v_ccd250")
    table = recorded("e2v_ccd250_70", seed=5109)
    found = diagnose_measured(measure_reduced(table, reach=4), baseline)
    assert found.mismatch.detected
    assert "bf_nonlinear" not in json.dumps(found.to_report()["effects"])


@pytest.mark.slow
def test_the_command_line_lets_the_operating_point_move(tmp_path):
    table = recorded("e2v_ccd250_70", seed=5107)
    j, i = np.indices(table.a.shape)
    path = tmp_path / "areas.csv"
    Table(
        {"i_serial": i.ravel(), "j_parallel": j.ravel(), "cov_per_e": table.a.ravel(),
         "err_per_e": table.errors.ravel()}
    ).write(path, format="ascii.csv")  # fmt: skip
    given = ["diagnose", str(path), "--baseline", "e2v_ccd250", "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(main, [*given, "--towards", "e2v_ccd250_70"])
    assert done.exit_code == 0
    told = json.loads((tmp_path / "out" / "report.json").read_text())
    (bias,) = told["effects"][0]["parameters"].values()
    assert bias["lo95"] < -70.0 < bias["hi95"] and bias["hi95"] - bias["lo95"] < 12.0
    other = CliRunner().invoke(main, [*given, "--towards", "itl_sta3800c"])
    assert other.exit_code == 1
    assert "are not of one device at two operating points" in other.stderr
    wrong = CliRunner().invoke(main, ["diagnose", str(path), "--towards", "e2v_ccd250_70"])
    assert wrong.exit_code == 2 and "--towards needs a --baseline" in wrong.stderr
