"""What the mesh of sweeps and fits costs in accuracy and in time, on up to 64 cells a pixel.

``python -m validation.boundaries.sweep_mesh`` solves two devices as ``bfsensor sweep`` does, at a
level of 40,000 e-, and writes the a_ij of light that converts at the back.
"""

from __future__ import annotations

import argparse
from typing import Any

from astropy.table import Table

from bfsensor.device.device import Device
from bfsensor.response.edge_response import LEVEL
from bfsensor.sweeps.points import SweepPoint, solve_point
from validation.common.write_results import RESULTS, write_results

DEVICES = ("itl_sta3800c", "e2v_ccd250")

CELLS = (16, 24, 32, 48, 64)
"""Cells a pixel: the default of sweeps, those between, the one of fits and the reference."""

LAGS = ((0, 0), (1, 0), (0, 1), (1, 1))


def solve(name: str, cells: int) -> dict[str, Any]:
    """Row of one device on one mesh."""
    text = Device.load(name).to_toml()
    found = solve_point(SweepPoint(text, level=LEVEL, full_pixel=0.0, cells=cells))
    if found.reason:
        raise RuntimeError(f"{name} on {cells} cells a pixel: {found.reason}")
    a = {f"a_{i}{j}_per_e": float(found.a[-1, j, i]) for i, j in LAGS}
    return {"device": name, "cells": cells, **a, "cpu_s": round(found.cpu_seconds, 2)}


def main() -> None:
    """Solve, print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    solve(DEVICES[0], 8)  # compiles, which the seconds are not to hold
    table = Table([solve(name, cells) for name in DEVICES for cells in CELLS])
    table.pprint(max_lines=-1, max_width=-1)
    path = RESULTS / "sweep_mesh.ecsv"
    write_results(table, path, "python -m validation.boundaries.sweep_mesh")


if __name__ == "__main__":
    main()
