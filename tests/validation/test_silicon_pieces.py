"""What the page on pieces of silicon physics says holds in its rows, and cheap rows come out again."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor import Device
from validation.quoted_numbers import read_rows
from validation.silicon import pieces
from validation.silicon.quoted import RESULTS, select


def value(piece, what, **at):
    (row,) = select(read_rows, piece, what, **at)
    return float(row["value"]), float(row["error"])


def test_traced_electrons_widen_as_the_field_says():
    traced, error = value("charge_diffusion", "traced, all pixels")
    told, _ = value(
        "charge_diffusion", "expected, all pixels", device=pieces.ITL, at="-50 V"
    )
    assert abs(traced - told) < 3 * error and traced > 10 * error


def test_alternating_columns_drop_out_to_first_order():
    what = "largest change of a covariance over C_10"
    one, two = (
        value("columns", what, at=f"edges {n} % more and less")[0] for n in (10, 20)
    )
    assert two / one == pytest.approx(4, rel=0.02) and one < 0.2
    what = "C_10 of even columns less that of odd"
    one, two = (
        value("columns", what, at=f"edges {n} % more and less")[0] for n in (10, 20)
    )
    assert two / one == pytest.approx(2, rel=0.01)


def test_direct_spots_grow_more_at_all_levels_alike():
    low, middle, high = (
        value("charge_diffusion", "direct over sensor, less 1", at=f"{n} e-")
        for n in (20000, 80000, 150000)
    )
    # Errors of one spot left out may be too small by a half.
    for one in (low, middle):
        assert abs(one[0] - high[0]) < 3 * np.hypot(one[1], high[1])
    assert high[0] > 4 * high[1]


@pytest.mark.parametrize("part", [pieces.arriving, pieces.yields])
def test_rows_come_out_again(part):
    again = pieces.Rows()
    part(again, Device.load(pieces.ITL))
    # Empty texts are read as missing.
    kept = {
        (*("" if v is np.ma.masked else v for v in tuple(r)[:4]), *tuple(r)[4:6]): float(
            r["value"]
        )
        for r in read_rows(RESULTS)
    }
    for row in again.rows:
        assert kept[row[:6]] == pytest.approx(row[6], rel=1e-6, abs=1e-12)
