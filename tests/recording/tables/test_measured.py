"""Measured tables to which a device is fitted: files of every kind, conditions, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from bfsensor.device.condition import Condition
from bfsensor.errors import RecordingError
from bfsensor.recording.tables.measured import read_measured
from bfsensor.recording.tables.setting_tables import read_setting_table
from tests.recording.tables.test_lsst_datasets import lsst_a, photon_transfer_table

AREAS = (
    "i_serial,j_parallel,cov_per_e,err_per_e\n"
    "0,0,-1e-6,1e-8\n1,0,1e-7,1e-8\n0,1,2e-7,1e-8\n1,1,1e-8,1e-9\n"
)


def test_a_header_states_the_condition(tmp_path):
    path = tmp_path / "areas.ecsv"
    table = Table(
        [[0, 1, 0], [0, 0, 1], [-1e-6, 1e-7, 2e-7], [1e-8, 1e-8, 1e-8]],
        names=("i_serial", "j_parallel", "cov_per_e", "err_per_e"),
    )
    table.meta["conditions"] = {"back_bias": "-60 V", "wavelength": "0.62 um"}
    table.write(path, format="ascii.ecsv")
    found = read_measured(path)
    assert found.condition == Condition(wavelength=620.0, back_bias=-60.0)
    assert found.table.a[1, 0] == 2e-7
    # What is said later counts.
    assert found.at({"back_bias": "-50 V"}).condition.back_bias == -50.0
    assert found.condition.back_bias == -60.0


def test_amplifiers_are_averaged_with_the_error_of_their_mean(tmp_path):
    table = photon_transfer_table()
    rng = np.random.default_rng(31)
    rows = [dict(zip(table.colnames, table[0], strict=True)) for _ in range(6)]
    sides = [
        row["A_MATRIX"] * (1 + 0.1 * rng.normal(size=row["A_MATRIX"].shape)) for row in rows
    ]
    for n, row in enumerate(rows):
        row["A_MATRIX"], row["AMPLIFIER_NAME"] = sides[n], f"C{n:02d}"
    many = Table(rows=rows, names=table.colnames)
    many.meta = table.meta
    path = tmp_path / "ptc.ecsv"
    many.write(path, format="ascii.ecsv")
    found = read_measured(path).table
    # LSST's [i][j] against our [j, i].
    expected = np.mean(sides, axis=0).reshape(lsst_a(4).shape).T
    np.testing.assert_allclose(found.a, expected, rtol=1e-9)
    scatter = np.std(sides, axis=0, ddof=1).reshape(4, 4).T / np.sqrt(6)
    np.testing.assert_allclose(found.errors, scatter, rtol=1e-6)
    assert found.a[1, 0] > found.a[0, 1]
    table.write(tmp_path / "two.ecsv", format="ascii.ecsv")
    with pytest.raises(RecordingError, match=r"two\.ecsv: 2 .*A_MATRIX.* 3"):
        read_measured(tmp_path / "two.ecsv")


def test_repeated_measurements_are_read_once(tmp_path):
    path = tmp_path / "slopes.csv"
    path.write_text(
        "# comment\nVbb_V,Vpar_hi_V,axis,meas_pct_per_50ke,meas_err,sim\n"
        "-60,4,x,0.71,0.09,0.7\n-60,4,y,0.71,0.07,0.9\n-60,4,x,0.71,0.09,0.5\n"
    )
    found = read_setting_table(path)
    assert found.axes == ("x", "y")
    assert len(found.values) == 2 and found.warnings[0].startswith("1 rows ")
    assert found.conditions[0] == Condition(back_bias=-60.0, gate_high=4.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "i_serial.* are a, b$"),
        ("i,j,cov,mu_e\n0,0,1,1\n", "fit_covariances.*i_serial"),
        ("axis,slope\nz,1\n", "axis = 'z' .*'x' nor 'y'"),
        (
            "saturation,saturation_error\n1e5,0\n",
            "saturation_error = 0 must be a number above 0",
        ),
        ("saturation\nnan\n", "saturation = nan must be a finite number"),
    ],
)
def test_refusals(tmp_path, text, message):
    path = tmp_path / "one.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_measured(path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"bias": "-60 V"}, "'bias' .* back_bias, gate_high"),
        ({"back_bias": "-60"}, "back_bias: '-60' has no unit"),
        ({"wavelength": "620 K"}, "wavelength: '620 K' is not a length"),
        ({"sigma": "99"}, "sigma = '99' .*0.1 to 10 pixels"),
        ({"sigma": "wide"}, "sigma = 'wide'"),
    ],
)
def test_conditions_that_are_none(tmp_path, given, message):
    path = tmp_path / "areas.csv"
    path.write_text(AREAS)
    with pytest.raises(RecordingError, match=message):
        read_measured(path).at(given)
    with pytest.raises(RecordingError, match=r"none\.csv: no such file"):
        read_measured(tmp_path / "none.csv")


def test_a_recording_states_the_level_of_its_response(tmp_path):
    path = tmp_path / "areas.csv"
    path.write_text(AREAS)
    measured = read_measured(path)
    assert measured.condition.level is None
    assert measured.at({"level": "0"}).condition.level == 0
    assert measured.at({"level": "2.5e4 e-"}).condition.level == 25_000
    for wrong in ("-1", "many", "inf", "nan"):
        with pytest.raises(
            RecordingError, match=r"level = .* from 0 to 1e.09 e-, such as 40000"
        ):
            measured.at({"level": wrong})
