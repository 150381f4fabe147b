"""Shifts of single edges: away from the charge on every side, or in one direction."""

import numpy as np
import pytest

from bfsensor.diagnose.explain.edge_terms import UNIT, shifts_of


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("across", [0, 2])
def test_even_shifts_lead_away_from_the_charge(axis, across):
    """The edge at -1 of a pixel's right (upper) edges is the left (lower) one of the charge's pixel."""
    kernels = dict(zip("xy", shifts_of((axis, 1, across), (7, 7)), strict=True))
    expected = np.zeros((7, 7))
    for over in {across, -across}:
        y, x = (3 + over, 3 + 1) if axis == "x" else (3 + 1, 3 + over)
        expected[y, x] = UNIT
        y, x = (3 + over, 3 - 2) if axis == "x" else (3 - 2, 3 + over)
        expected[y, x] = -UNIT
    np.testing.assert_array_equal(kernels[axis], expected)
    assert not kernels["y" if axis == "x" else "x"].any()
