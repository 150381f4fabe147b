"""Convergence of area changes with the mesh, at three conversion depths.

``python -m validation.boundaries.convergence [--device NAME] [--finest 64] [-o OUT.ecsv]`` solves
one pixel with 100,000 e- on a period of 6 pixels (up to 64 cells a pixel) and of 12 pixels with the
images taken out (up to 32), on up to three z meshes, prints the table and writes it.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

import numpy as np
from astropy.table import Table

from bfsensor.device.device import Device
from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.table.levels import solve_level
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import plan_table
from validation.common.write_results import write_results

CHARGE = 1e5
DEPTHS = (10.0, 50.0, 95.0)
VERTICES = 16


def small_period(device: Device, cells: int, refine_z: int) -> list[dict[str, float]]:
    """Area changes of the centre and the nearest lags on a period of 6 pixels."""
    mesh = make_mesh(device, pixels=(6, 6), cells=cells, refine_z=refine_z)
    solver = Electrostatics(device, mesh)
    charges = np.zeros(solver.pixel_shape)
    charges[0, 0] = CHARGE
    start = tile(solve_unit_cell(device, 0.0, cells=cells, refine_z=refine_z), mesh)
    lines = find_boundaries(solver.solve(charges, start=start), DEPTHS, reach=1)
    arrays = lines.vertices(VERTICES, vertex_fractions(VERTICES))
    return _rows(device, lines.reach, arrays, 6, cells, refine_z)


def whole_table(device: Device, cells: int, refine_z: int) -> list[dict[str, float]]:
    """Area changes up to (3, 3) as a table has them."""
    plan = plan_table(
        device,
        charges=[CHARGE],
        backgrounds=[0.0],
        depths=DEPTHS,
        vertices=VERTICES,
        accuracy=0.05,
    )
    level = solve_level(replace(plan, cells=cells, refine_z=refine_z), CHARGE, 0.0)
    return _rows(
        device, 4, (level.corners, level.horizontal, level.vertical), 12, cells, refine_z
    )


def _rows(device, reach, arrays, period, cells, refine_z) -> list[dict[str, float]]:
    table = DistortionTable(
        np.array([CHARGE]), np.zeros(1), np.array(DEPTHS), (device.pixel.pitch_x, device.pixel.pitch_y),
        device.silicon.thickness, VERTICES, reach, *(a[None, None] for a in arrays),
    )  # fmt: skip
    rows = []
    for depth in DEPTHS:
        change = table.area_changes(charge=CHARGE, depth=depth)
        row = {
            "device": device.name,
            "period": period,
            "cells": cells,
            "refine_z": refine_z,
            "depth_um": depth,
        }
        for i, j in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (3, 3)):
            inside = max(i, j) <= reach
            row[f"dA_{i}{j}_um2"] = (
                round(float(change[reach + j, reach + i]), 4) if inside else np.nan
            )
        rows.append(row)
    return rows


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", nargs="*", default=["itl_sta3800c", "e2v_ccd250"])
    parser.add_argument("--finest", type=int, default=64)
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    rows: list[dict[str, float]] = []
    for name in args.device:
        device = Device.load(name)
        meshes = [
            (small_period, cells, 0) for cells in (8, 16, 32, 64) if cells <= args.finest
        ]
        meshes += [(small_period, 16, refine) for refine in (1, 2)]
        meshes += [(whole_table, cells, 0) for cells in (8, 16, 32) if cells <= args.finest]
        meshes += [(whole_table, 16, 1)]
        for function, cells, refine in meshes:
            began = time.process_time()
            rows += function(device, cells, refine)
            print(
                f"{name} {function.__name__} {cells} {refine}: {time.process_time() - began:.1f} CPU s",
                file=sys.stderr,
            )
    table = Table(rows)
    print("\n".join(table.pformat(max_lines=-1, max_width=-1)))
    for name in args.device:
        _orders(table[table["device"] == name])
    if args.output:
        write_results(table, args.output, "python -m validation.boundaries.convergence")


def _orders(table: Table) -> None:
    """Observed order of each area change on the small period, and the error that is left."""
    for depth in DEPTHS:
        use = (
            (table["period"] == 6) & (table["refine_z"] == 0) & (table["depth_um"] == depth)
        )
        part = table[use]
        part.sort("cells")
        for name in ("dA_00_um2", "dA_10_um2", "dA_01_um2", "dA_11_um2"):
            values = np.array(part[name])
            steps = np.abs(np.diff(values))
            orders = np.log2(steps[:-1] / steps[1:])
            left = [f"{100 * (v / values[-1] - 1):+.2f} %" for v in values[:-1]]
            print(
                f"{table['device'][0]} z = {depth:g} um {name}: steps {np.round(steps, 4)}, "
                f"order {np.round(orders, 1)}, from the finest {', '.join(left)}"
            )


if __name__ == "__main__":
    main()
