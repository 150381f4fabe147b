"""How the shipped tables respond to charge and depth, and the errors that their headers state.

``python -m validation.boundaries.shipped_tables`` reads the tables; nothing is solved.
"""

from __future__ import annotations

import argparse
from typing import Any

from astropy.table import Table

from bfsensor.table.table import DistortionTable
from validation.common.write_results import RESULTS, write_results

DEVICES = ("itl_sta3800c", "e2v_ccd250")

CHARGES = (10e3, 30e3, 61e3, 100e3, 130e3)
"""Source charges [e-]: from a tenth of the full well of ITL's pixel to three quarters of it."""

HEIGHTS = (5.0, 10.0, 20.0, 40.0)
"""Heights of conversion [um] at which GalSim's tanh(z / 12 um) is not yet 1."""


def describe(name: str) -> list[dict[str, Any]]:
    """Rows of one table: area that the filled pixel loses, by charge and by height; errors."""
    table = DistortionTable.load(name)
    n, back = table.reach, float(table.depths[-1])

    def lost(charge: float, depth: float) -> float:
        return -float(table.area_changes(charge=charge, depth=depth)[n, n])

    rows = [
        ("area lost per 100,000 e-", charge, "um2", lost(charge, back) * 1e5 / charge)
        for charge in CHARGES
    ]
    rows += [
        (
            "area lost at a height over that at the back",
            z,
            "",
            lost(1e5, z) / lost(1e5, back),
        )
        for z in HEIGHTS
    ]
    rows += [
        (f"levels of {what}", float("nan"), "", float(len(values)))
        for what, values in (
            ("charge", table.charges), ("background", table.backgrounds), ("depth", table.depths),
        )
    ]  # fmt: skip
    rows += [(what, float("nan"), "header", value) for what, value in table.errors.items()]
    names = ("what", "at", "unit", "value")
    return [{"device": name, **dict(zip(names, row, strict=True))} for row in rows]


def main() -> None:
    """Write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    table = Table([row for name in DEVICES for row in describe(name)])
    table.pprint(max_lines=-1, max_width=-1)
    path = RESULTS / "shipped_tables.ecsv"
    write_results(table, path, "python -m validation.boundaries.shipped_tables")


if __name__ == "__main__":
    main()
