"""Data sets: what is kept of measured tables, and the published ones as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.errors import FitError
from bfsensor.fit.data import MODEL_ERROR, apart_from_readout, area_data, data_set, select
from bfsensor.recording.tables.measured import read_measured

DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize("name", ["itl", "e2v"])
def test_published_areas_without_what_the_sum_rule_set(name):
    data = data_set(read_measured(DATA / f"{name}_covariances_21oct19.csv"))
    assert len(data.values) == 24 and "(0,0)" not in data.labels
    # Neighbours first, in y the larger.
    assert data.labels[:3] == ("(1,0)", "(0,1)", "(1,1)")
    assert data.values[1] > 2 * data.values[0] > 0
    assert set(data.conditions) == {Condition()}
    assert data_set(
        read_measured(DATA / f"{name}_covariances_21oct19.csv"), lags=8
    ).values.shape == (80,)


def test_published_slopes_and_saturation():
    slopes = data_set(read_measured(DATA / "bf_slopes.csv"))
    assert slopes.kind == "slopes" and len(slopes.values) == 6
    assert slopes.labels[0] == "x back bias -60 V, gates -8/4 V"
    expected = np.hypot(0.09, MODEL_ERROR["slopes"] * 0.71)
    assert slopes.errors[0] == pytest.approx(expected)
    wells = data_set(read_measured(DATA / "sat_data_21oct19.csv"))
    assert wells.kind == "saturation" and wells.conditions[3].gate_high == 1.5
    assert "sat_data_21oct19.csv" in wells.notes[0] and "2 %" in wells.notes[0]
    np.testing.assert_allclose(wells.errors, 0.02 * wells.values)


def test_a_row_states_its_own_setting(tmp_path):
    path = tmp_path / "slopes.csv"
    path.write_text("back_bias,axis,slope,slope_error\n-60,x,0.7,0.1\n,y,0.9,0.1\n")
    measured = read_measured(path).at({"back_bias": "-30 V", "sigma": "1.1"})
    data = data_set(measured)
    assert [c.back_bias for c in data.conditions] == [-60.0, -30.0]
    assert data.sigma == 1.1 and data.places[:, 0].tolist() == [0, 1]


def test_selection_and_refusals():
    a = np.full((3, 3), 1e-8)
    data = area_data("nine", a, 0.1 * a, lags=2)
    assert select(data, data.places[:, 0] == 0, "column").labels == (
        "(0,0)", "(0,1)", "(0,2)",
    )  # fmt: skip
    with pytest.raises(FitError, match=r"nine: .*above 0"):
        area_data("nine", a, 0 * a)
    with pytest.raises(FitError, match="nine: no values"):
        area_data("nine", np.nan * a, a)
    with pytest.raises(FitError, match=r"must both be \(ny, nx\)"):
        area_data("nine", a, a[0])


def test_a_readout_takes_its_lags_out_of_the_fit():
    a = np.arange(1, 10).reshape(3, 3) * 1e-8
    device, readout = apart_from_readout(area_data("flats", a, 0.1 * a), 2)
    assert readout.labels == ("(1,0)", "(2,0)") and not readout.fitted
    assert device.fitted and len(device.values) == 7 and "(0,1)" in device.labels
    with pytest.raises(FitError, match=r"flats: of 1 lags 0 are \(1,0\) to \(2,0\)"):
        apart_from_readout(area_data("flats", a, 0.1 * a, lags=0), 2)
