"""Rows of star sizes: which there are, and what they say."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.table import Table

from validation.correction import star_sizes
from validation.correction.calibration_mocks import coverage


def made_rows(seeds=4):
    """Stars of one kind that grow by 2 and 3 % for 100,000 e-, of which a tenth is left."""
    rng = np.random.default_rng(14)
    rows = []
    for seed in range(seeds):
        for peak in star_sizes.PEAKS:
            noise = rng.normal(0, 1e-3, 2)
            row = {"device": "itl_sta3800c", "width": 2.0, "sky": 0.0, "band": "r", "seed": seed,
                   "peak": peak}  # fmt: skip
            for name, part in (("none", 1.0), ("table", 0.1)):
                row[f"x {name}"] = 2e-5 * peak * part + noise[0]
                row[f"y {name}"] = 3e-5 * peak * part + noise[1]
                row[f"e {name}"] = -4e-9 * peak * part
            rows.append(row)
    rows.append({**rows[0], "peak": star_sizes.NEIGHBOUR, "x none": 99.0})
    return Table(rows=rows)


def test_there_is_a_row_for_every_case():
    keys = list(star_sizes.cases(2))
    assert len(keys) == 2 * (216 + 6)
    assert len({tuple(key.values()) for key in keys}) == len(keys)
    # Of each case one star before the second.
    assert [key["seed"] for key in keys] == sorted(key["seed"] for key in keys)


def test_what_is_left_of_slopes():
    rows = star_sizes.select(made_rows(), device="itl_sta3800c", width=2.0)
    assert len(rows) == 16
    for axis in "xy":
        value, error = star_sizes.left(rows, "table", axis)
        assert value == pytest.approx(10, abs=4 * error + 0.05) and 0 < error < 0.2
        assert star_sizes.together(rows, "table", axis)[0] == pytest.approx(value)
    assert star_sizes.shape_left(rows, "table")[0] == pytest.approx(-4e-5)
    # m is the growth of the trace, c half the ellipticity, for a galaxy as large as the star.
    m, c = star_sizes.bias_left(rows, "table")
    assert m == pytest.approx(0.0025 * 1.0025, rel=0.05)
    assert c == pytest.approx(2e-5, rel=0.01)


def test_coverage_counts_both_axes():
    rows = Table({"left_x": [0.5, 3.0], "error_x": [1.0, 1.0], "left_y": [1.5, -0.1],
                  "error_y": [1.0, 1.0]})  # fmt: skip
    assert coverage(rows)["within_68"] == 50.0 and coverage(rows)["within_95"] == 75.0
