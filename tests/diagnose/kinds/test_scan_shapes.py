"""Shapes that maps are searched for lie where they are reported to lie."""

from __future__ import annotations

import numpy as np

from bfsensor.diagnose.kinds.scan_shapes import boxes


def test_boxes_lie_where_they_are_reported():
    """Means of columns and of rows of a map of 64 rows and 96 columns."""
    columns, rows = np.arange(96.0), np.arange(64.0)
    axes = {
        "what": np.repeat(["column", "row", "block"], [96, 64, 1]),
        "x": np.concatenate([columns, np.full(64, -1.0), [0.5]]),
        "y": np.concatenate([np.full(96, -1.0), rows, [0.5]]),
    }
    found = list(boxes(axes, np.ones(161, bool), "flat"))
    assert len(found) > 4
    for _, pattern, place in found:
        for axis, there, part in (("x", columns, slice(96)), ("y", rows, slice(96, 160))):
            low, high = place[axis]
            inside = (there >= low) & (there < high)
            assert inside.any() and np.array_equal(pattern[part] > 0, inside)
