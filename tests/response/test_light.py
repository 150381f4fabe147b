"""Where light converts: weights of heights, and heights that are close enough."""

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device import silicon
from bfsensor.response.edge_response import area_matrix, solve_response
from bfsensor.response.light import conversion_depths, conversion_weights


@pytest.mark.parametrize("wavelength", [400.0, 700.0, 950.0, 1100.0, 1500.0])
def test_weights_are_mean_responses(wavelength):
    """Against photons drawn one by one: a response linear between the depths."""
    depths = np.array([1.0, 5.0, 20.0, 50.0, 100.0])
    response = np.array([0.0, 0.4, 0.8, 0.97, 1.0])
    weights = conversion_weights(depths, wavelength, 173.0)
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    length = min(float(silicon.absorption_length(wavelength, 173.0)), 1e9)
    uniform = np.random.default_rng(771).uniform(size=400_000)
    # Depths of the photons that convert in the silicon above the first depth.
    z = 100.0 + length * np.log1p(-uniform * -np.expm1(-99.0 / length))
    drawn = np.interp(z, depths, response)
    sigma = drawn.std() / np.sqrt(len(drawn))
    assert weights @ response == pytest.approx(drawn.mean(), abs=4 * sigma + 1e-9)


def test_temperature_moves_where_light_converts():
    depths = np.linspace(0.9, 100.0, 40)
    cold, warm = (conversion_weights(depths, 950.0, t) @ depths for t in (173.0, 293.0))
    assert warm - cold > 3.0  # warmer silicon absorbs nearer to the back


def test_light_above_the_last_depth_counts_there():
    weights = conversion_weights(np.array([1.0, 95.0]), 400.0, 173.0, thickness=100.0)
    assert weights[1] == pytest.approx(1, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["itl_sta3800c", "e2v_ccd250"])
def test_ten_heights_are_enough(name, monkeypatch):
    """Against 26 heights, in light from 650 to 1050 nm."""
    from bfsensor.response import edge_response

    device = Device.load(name)
    few = solve_response(device, cells=16, refine_z=0)
    stored, lowest, split, *_, top = conversion_depths(device)
    dense = stored, *np.linspace(lowest, split, 5), *np.geomspace(split, top, 21)[1:]
    monkeypatch.setattr(edge_response, "conversion_depths", lambda device: dense)
    many = solve_response(device, cells=16, refine_z=0)
    middle = len(few.kx[0]) // 2
    limits = {
        (0, 0): 3e-3,
        (1, 0): 6e-3,
        (0, 1): 2e-3,
        (1, 1): 4e-3,
        (2, 0): 7e-3,
        (0, 2): 7e-3,
    }
    for wavelength in (650.0, 800.0, 950.0, 1050.0):
        one, other = (area_matrix(*r.edges(wavelength, 173.0)) for r in (few, many))
        for (i, j), limit in limits.items():
            at = middle + j, middle + i
            assert one[at] == pytest.approx(other[at], rel=limit), (wavelength, i, j)
