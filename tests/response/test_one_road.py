"""There is one way from a device to its response, and all who ask get the same answer."""

import re
from pathlib import Path

import numpy as np
import pytest

import bfsensor
from bfsensor import Device
from bfsensor.diagnose.model.cached_response import walk
from bfsensor.response.edge_response import LEVEL, REACH, area_matrix, solve_response
from bfsensor.sweeps.points import SweepPoint, solve_point
from bfsensor.table.build import build_table
from bfsensor.table.quadrant_shifts import quadrant_shifts
from bfsensor.table.table_plan import plan_table

CODE = {p: p.read_text() for p in Path(bfsensor.__file__).parent.rglob("*.py")}


@pytest.mark.parametrize(
    ("what", "pattern"),
    [
        ("level", r"^LEVEL = 40_000"),
        ("weights of depths", r"^def \w*(conversion|light)_weights\("),
        ("heights of conversion", r"^def (conversion_depths|response_depths)\("),
        ("height of the stored charge", r"^STORAGE_DEPTH = "),
        ("solution of a response", r"^def solve_response\("),
        ("start of an array", r"^class PixelArray"),
    ],
)
def test_there_is_one_definition(what, pattern):
    places = [p.name for p, text in CODE.items() if re.search(pattern, text, re.MULTILINE)]
    assert len(places) == 1, (what, places)


@pytest.mark.parametrize("wavelength", [None, 870.0, 950.0, 1000.0])
def test_all_who_ask_get_the_same_response(wavelength, answers):
    fitted, diagnosed, swept, table = answers
    near = slice(REACH + 1, REACH + 4)
    fit, diagnosis = (
        area_matrix(*found.edges(wavelength, 173.0))[near, near]
        for found in (fitted, diagnosed)
    )
    sweep, _ = swept.in_light(wavelength, 173.0)
    export = quadrant_shifts(
        table, background=LEVEL, wavelengths=None if wavelength is None else [wavelength],
        temperature=173.0, lags=3, tail_slope=None,
    ).areas  # fmt: skip
    # The bisection ends at 1e-5 um in sweeps and tables, where (2, 2) counts a hundred times that; it
    # ends at 1e-6 in diagnoses and at 1e-7 in fits, which take differences of devices.
    np.testing.assert_allclose(diagnosis, fit, rtol=1e-3)
    for finer in (fit, diagnosis):
        np.testing.assert_allclose(finer[:2, :2], sweep[:2, :2], rtol=1e-3)
        np.testing.assert_allclose(finer, sweep, rtol=6e-3)
    # A table's mesh is not halved in z, 0.4 %, and it is cubic between depths instead of linear, 0.2 %.
    np.testing.assert_allclose(export[:2, :2], sweep[:2, :2], rtol=6e-3)


@pytest.fixture(scope="module")
def answers():
    device = Device.load("itl_sta3800c")
    return (

        solve_response(device, cells=16),
        walk(device, cells=16),
        solve_point(SweepPoint(device.to_toml(), LEVEL, 0.0, 16)),
        build_table(
            plan_table(
                device, charges=[LEVEL, LEVEL + 5e3], backgrounds=[LEVEL], accuracy=0.05,
            )
        ),
    )  # fmt: skip
