"""The fitted devices that are shipped: their files agree with the fit beside them."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor import BrighterFatterSensor
from bfsensor.device.device import Device
from bfsensor.device.parameters import parameter_value
from bfsensor.device.quantities import quantities
from bfsensor.device.shipped import tables_dir
from bfsensor.fit.prediction_error import DRAWS
from bfsensor.fit.result import FitResult
from bfsensor.response.edge_response import CHARGE
from bfsensor.table.table import DistortionTable

FITTED = {"itl_sta3800c_2019": "itl_sta3800c_60", "e2v_ccd250_2019": "e2v_ccd250_70"}


@pytest.mark.parametrize("name", FITTED)
def test_device_is_that_of_its_fit(name):
    device = Device.load(name)
    fit = FitResult.read(tables_dir() / name / "fit.json")
    for parameter, value, error in zip(fit.parameters, fit.value, fit.error, strict=True):
        assert parameter_value(device, parameter) == pytest.approx(value, rel=1e-6)
        known = device.provenance[parameter]
        assert known.origin == "fitted"
        assert known.uncertainty == pytest.approx(error, rel=1e-3)
        assert "fit.json" in known.source
    # What was held is that of the device from which the fit began.
    began = quantities(Device.load(FITTED[name]))
    for parameter, quantity in quantities(device).items():
        if parameter not in fit.parameters:
            assert quantity.value == pytest.approx(began[parameter].value, rel=1e-12)


@pytest.mark.parametrize("name", FITTED)
def test_sensor_by_name_shows_what_was_measured(name):
    sensor = BrighterFatterSensor(name)
    table = sensor.table
    assert table.device_text == Device.load(name).to_toml()
    fit = FitResult.read(tables_dir() / name / "fit.json")
    (data,) = fit.sets
    # The fits are to the limit at no charge.
    change = table.area_changes(charge=CHARGE, background=0.0, depth=table.thickness)
    a = change[table.reach :, table.reach :] / (CHARGE * table.pitch[0] * table.pitch[1])
    i, j = data.places.T
    # The nearest four lags without (0, 0): 1.7 % (ITL), from the table between no charge and its
    # first (1.2 %) and from the meshes.
    near = np.isin([f"{i},{j}" for i, j in data.places], ("1,0", "0,1", "1,1", "2,0"))
    assert near.sum() == 4
    assert np.max(np.abs((a[j, i] / data.after)[near] - 1)) < 0.02
    assert np.max(np.abs((a[j, i] / data.values)[:3] - 1)) < 0.05
    before = DistortionTable.read(tables_dir() / FITTED[name] / "table.fits")
    assert before.device_text != table.device_text


@pytest.mark.parametrize("name", FITTED)
def test_fit_beside_a_device(name):
    fit = FitResult.read(tables_dir() / name / "fit.json")
    (data,) = fit.sets
    assert len(data.values) == 24 and not np.any(np.all(data.places == 0, axis=1))
    assert data.chi2 < data.chi2_before
    assert np.max(np.abs(data.after[:3] / data.values[:3] - 1)) < 0.05
    assert np.all(np.abs(fit.pulls) < 3)
    # Errors hold what predictions miss, as every fit by the command now has it.
    assert fit.posterior["solved"] == DRAWS
    # What the device's file cannot hold: errors that parameters share.  As independent ones they
    # would leave the best known combination several times as open as the fit does.
    weights = fit.weights[0] / fit.spread
    alone = float(np.sqrt(weights**2 @ np.diag(fit.covariance)))
    together = float(np.sqrt(weights @ fit.covariance @ weights))
    assert together < 0.5 * alone
