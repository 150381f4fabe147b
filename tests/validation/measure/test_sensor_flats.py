"""Flats of the GalSim sensor, measured and fitted, beside what its table implies."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.measure.covariance_fit import fit_covariances
from bfsensor.measure.curve import measure_curve
from bfsensor.sensor.flats import draw_flat
from validation.sensor.sensor_flats import predict

DEVICE = "e2v_ccd250"


@pytest.mark.slow
def test_flats_of_the_sensor_have_the_covariances_of_its_table():
    """Areas by charge and background, no linear kernel: the fit's b takes the change up."""
    sensor = BrighterFatterSensor(DEVICE, rng=galsim.BaseDeviate(3))
    seeds = iter(range(9100, 9200))

    def pairs():
        for level in np.repeat([8e3, 2.5e4, 5e4], 5):
            yield [
                draw_flat(sensor, (256, 256), level, rng=galsim.BaseDeviate(next(seeds)),
                          dtype=np.float64).array
                for _ in range(2)
            ]  # fmt: skip

    fit = fit_covariances(measure_curve(pairs(), lags=2, unit="electron"), gain=1.0,
                          constant_a=True)  # fmt: skip
    assert fit.p_value > 1e-3
    level = 5e4
    table = DistortionTable.read(tables_dir() / DEVICE / "table.fits")
    implied = predict(table, level)[:3, :3]
    implied[0, 0] -= level
    found = fit.model([level])[0] - fit.noise
    found[0, 0] -= level
    error = level**2 * fit.a_errors
    assert np.all(np.abs(found - implied) < 4 * error + 0.02 * np.abs(implied))
    assert found[0, 0] < -15 * error[0, 0]
    assert found[1, 0] > 8 * error[1, 0]
