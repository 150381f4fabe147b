"""The response that a flat of a level has felt, against the equation integrated level by level."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.device.shipped import tables_dir
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.flat_predictions import flat_covariances_of
from bfsensor.diagnose.model.table_baseline import baseline_of_table
from bfsensor.table.table import DistortionTable
from validation.sensor.sensor_flats import predict as integrate

BACK = Condition(wavelength=400.0)
"""All of this light converts at the back surface, as the integration has it."""


@pytest.fixture(scope="module", params=["itl_sta3800c", "e2v_ccd250"])
def baseline(request: pytest.FixtureRequest) -> Baseline:
    return baseline_of_table(request.param)


@pytest.mark.parametrize("level", [2e4, 5e4, 8e4])
def test_near_lags_are_those_of_the_tables_own_response(
    baseline: Baseline, level: float
) -> None:
    true = integrate(
        DistortionTable.read(tables_dir() / baseline.name / "table.fits"), level
    )
    a = baseline.flat_areas(BACK, None, np.array([level]))
    found = flat_covariances_of(a, [level], lags=4)[0]
    for j, i in ((0, 1), (1, 0), (1, 1)):
        # What is not straight in the response, and the second order of it: 2.4 % at most.
        assert found[j, i] == pytest.approx(true[j, i], rel=0.03), (i, j)
    assert level - found[0, 0] == pytest.approx(level - true[0, 0], rel=0.03)


def test_one_response_for_all_levels_would_be_off(baseline: Baseline) -> None:
    table = DistortionTable.read(tables_dir() / baseline.name / "table.fits")
    true = integrate(table, 2e4)
    plain = Baseline(baseline.name, baseline.edges, {}, {}, baseline.reference)
    a = plain.flat_areas(BACK, None, np.array([2e4]))
    found = flat_covariances_of(a, [2e4], lags=4)[0]
    assert a.ndim == 2
    assert abs(found[0, 1] / true[0, 1] - 1) > 0.05


def test_each_level_has_its_own_areas() -> None:
    a = np.zeros((2, 3, 3))
    a[0, 1] = [1e-7, -2e-7, 1e-7]
    a[1, :, 1] = [2e-7, -4e-7, 2e-7]
    both = flat_covariances_of(a, [1e5, 5e4], lags=1)
    for n, level in enumerate((1e5, 5e4)):
        assert both[n] == pytest.approx(flat_covariances_of(a[n], [level], lags=1)[0])
