"""The figure of a fit shows every number."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from bfsensor.plots import fit as show_fit

LABELS = ["(1,0)", "(0,1)", "(2,0)", "(4,1)", "(4,4)"]
VALUES = np.array([7.2e-8, 17.6e-8, 2.3e-8, 8.0e-10, -2.3e-10])
ERRORS = np.array([2e-9, 2e-9, 2e-9, 2e-9, 2e-9])


def test_points_beyond_the_axis_or_in_the_noise_are_not_left_out():
    after = VALUES * [0.98, 1.01, 0.7, 2.6, -4.2]
    ax = Figure().add_subplot()
    show_fit.draw_ratios(
        LABELS, VALUES, ERRORS, VALUES * [1.04, 1.08, 0.5, 1.2, 1.0], after, ax
    )
    low, high = ax.get_ylim()
    drawn = [
        (line.get_marker(), x, y)
        for line in ax.lines
        if len(line.get_xdata()) and line.get_marker() != "None"
        for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)
    ]
    assert len(drawn) == 2 * len(LABELS)
    assert all(low < y < high for _, _, y in drawn)
    shapes = {round(x - 0.15): mark for mark, x, _ in drawn if x % 1 < 0.5}
    assert shapes == {0: "o", 1: "o", 2: "o", 3: "^", 4: "v"}
    # What the noise covers does not set the axis.
    assert high - 1 == pytest.approx(1.2 * 0.5)
