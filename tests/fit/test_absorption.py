"""A factor on the absorption length of light, fitted beside quantities of the device."""

import numpy as np
import pytest
from click.testing import CliRunner

from bfsensor.cli.main import main
from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import ABSORPTION, choose_priors
from bfsensor.fit.data import area_data
from bfsensor.fit.fit import fit_device
from bfsensor.fit.full_solutions import FullSolutions
from bfsensor.fit.linear_response import Linearise

DEVICE = Device.load("itl_sta3800c")
FREE = choose_priors(DEVICE, ("back_bias:2 V", ABSORPTION))
RED, BLUE = Condition(wavelength=900.0), Condition(wavelength=450.0)


@pytest.fixture(scope="module")
def solve():
    return Linearise(DEVICE, FREE, (RED, BLUE), cells=8)


def test_the_derivative_is_that_of_the_response(solve):
    means = np.array([prior.mean for prior in FREE])
    at = solve(means)
    step = np.array([0.0, 0.02])
    exact = [
        FullSolutions(DEVICE, FREE, (RED, BLUE), 8, 1)(means + side * step)
        for side in (1, -1)
    ]
    for condition in (RED, BLUE):
        found = at.predict(means, condition)
        up, down = (one.predict(np.zeros(0), condition) for one in exact)
        np.testing.assert_allclose(
            found.jacobian[1], (up.areas - down.areas) / 0.04, rtol=2e-3,
            atol=1e-4 * np.abs(found.areas).max(),
        )  # fmt: skip
    # Of red light a longer length moves more down to where boundaries shift less.
    red, blue = (at.predict(means, c) for c in (RED, BLUE))
    assert abs(red.jacobian[1, 0, 0] / red.areas[0, 0]) > 0.015
    assert abs(blue.jacobian[1, 0, 0] / blue.areas[0, 0]) < 1e-3


def test_a_fit_finds_the_light_that_was(solve):
    truth = np.array([FREE[0].mean - 1.0, 1.08])
    data = []
    for name, condition in (("red", RED), ("blue", BLUE)):
        exact = FullSolutions(DEVICE, FREE, (condition,), 8, 1)(truth)
        areas = exact.predict(np.zeros(0), condition).areas
        error = np.full(areas.shape, 1e-3 * areas[0, 1])
        data.append(area_data(name, areas, error, condition=condition, scaled=False))
    found = fit_device(DEVICE, data, FREE, None, linearise=solve)
    assert found.chi2 < 1.0
    assert np.all(np.abs(found.value - truth) < [0.05, 0.004])
    assert "absorption length over silicon's" in found.said()
    # The device's file has the bias; the light is none of its quantities.
    fitted = Device.from_toml(found.fitted_device)
    assert fitted.operating_point.back_bias == pytest.approx(truth[0], abs=0.05)
    assert ABSORPTION not in fitted.provenance


def test_without_a_wavelength_there_is_nothing_to_fit(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "i_serial,j_parallel,cov_per_e,err_per_e\n1,0,1e-8,1e-9\n0,1,2e-8,1e-9\n"
    )
    command = [
        "fit",
        "itl_sta3800c",
        str(path),
        "--free",
        ABSORPTION,
        "-o",
        str(tmp_path / "o"),
    ]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2
    assert "no recording states a wavelength" in result.output
