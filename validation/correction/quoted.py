"""Texts of results of corrections, for the pages that quote them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from astropy.table import Table

from validation.correction.calibration_mocks import coverage
from validation.correction.correction_round_trip import (
    LEVELS,
    flat_residuals,
    left_by_paths,
)

Rows = Callable[[str], Table]
"""Function that reads the rows of a result by its name."""


def direct_left(device: str, rows: Rows) -> str:
    """Growth of spots of the direct simulation that the table leaves [%], in x and y, with errors."""
    table = rows("direct_spots")
    part = table[(table["device"] == device) & (table["correction"] == "table")]
    found = [part[part["axis"] == axis][0] for axis in "xy"]
    return ", ".join(f"{row['left']:+.1f} ± {row['error']:.1f}" for row in found)


def flats_left(device: str, i: int, j: int, rows: Rows) -> str:
    """Covariance of flats that the table leaves [%], of what its areas give, from low to high levels."""
    table = rows("correction_flats")
    part = table[table["device"] == device]
    found = [
        flat_residuals(part, device, "whole", level, "table")[0][j, i] for level in LEVELS
    ]
    return ", ".join(f"{value:+.1f}" for value in found)


def flats_exact(device: str, i: int, j: int, rows: Rows) -> str:
    """Covariance of flats that an exact correction leaves [%], from low to high levels."""
    found = [left_by_paths(device, level, linear=False)[j, i] for level in LEVELS]
    return ", ".join(f"{value:+.1f}" for value in found)


def mocks_covered(within: str, rows: Rows) -> str:
    """Part of the calibration mocks within their errors [%]."""
    return f"{coverage(rows('calibration_mocks'))[within]:.0f}"


CORRECTED: dict[str, Callable[[Rows], str]] = {
    **{f"mocks {n}": partial(mocks_covered, f"within_{n}") for n in ("68", "95")},
    **{
        f"direct left {short}": partial(direct_left, device)
        for short, device in (("itl", "itl_sta3800c"), ("e2v", "e2v_ccd250"))
    },
    **{
        f"flats {name} e2v {i}{j}": partial(function, "e2v_ccd250", i, j)
        for i, j in ((0, 0), (1, 0), (0, 1))
        for name, function in (("left", flats_left), ("exact", flats_exact))
    },
}
"""Texts by the names that pages have for them."""
