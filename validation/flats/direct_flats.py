"""Flats of the direct simulation: what an electron does to its neighbours, and covariances.

``python -m validation.flats.direct_flats [--device NAME] [--flats N] [--workers N]`` builds up flats of
80,000 e- in a period of 13 x 13 pixels (20 steps, 8 cells a pixel; some 5 CPU minutes a flat),
electron by electron with diffusion, the charge fed back, beside the same electrons in evenly
filled wells.  Each flat is a row of ``validation/results/direct_flats.ecsv``: the fitted a-matrix
and the covariances of both images by lag.  Flats that are there already are not made again.
Beside them the a-matrix of tables on 8 cells, as the flats have, and on 16 and 32 goes to
``direct_flats_tables.ecsv``: the differential response at two thirds of the level, about which the
covariance of a flat averages it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from astropy.table import Table, vstack

from bfsensor import Device, build_table, plan_table
from bfsensor.direct.flat_exposure import (
    Flat,
    FlatPlan,
    periodic_covariances,
    simulate_flat,
)
from bfsensor.measure.pixel_response import measure_response
from bfsensor.sweeps.executors import open_executor
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "direct_flats.ecsv"
COMMAND = "python -m validation.flats.direct_flats"
PIXELS = 13


def reduce_flat(plan: FlatPlan, flat: Flat) -> Table:
    """One row: a-matrix and covariances by lag [j, i], mirrored lags averaged."""
    half = plan.pixels // 2 + 1
    quadrants = []
    for image in (flat.on[-1], flat.off[-1]):
        c = periodic_covariances(image[None])[0]
        mirrored = np.roll(c[::-1], 1, 0)
        quadrants.append((0.5 * (c + mirrored))[:half, :half].ravel())
    return Table(
        {
            "device": [plan.device.name],
            "flat": [flat.number],
            "level": [plan.level],
            "pixels": [plan.pixels],
            "steps": [plan.steps],
            "response": [measure_response(flat.on, flat.off).ravel()],
            "with_effect": [quadrants[0]],
            "without": [quadrants[1]],
            "moved": [int(np.abs(np.diff(flat.on - flat.off, axis=0, prepend=0)).sum() // 2)],
            "cpu_s": [round(flat.cpu_seconds, 1)],
        }
    )  # fmt: skip


def predict_responses(plan: FlatPlan) -> Table:
    """a-matrix [1/e-] of tables on several meshes, by lag."""
    background = plan.level * 2 / 3
    charges, depth = [background, background + 5000.0], plan.conversion_height
    rows = []
    for cells in (8, 16, 32):
        request = plan_table(
            plan.device, charges=charges, backgrounds=[background], depths=[50.0, depth]
        )
        table = build_table(replace(request, cells=cells))
        change = table.area_changes(charge=charges[1], background=background, depth=depth)
        a = change / 5000.0 / np.prod(table.pitch)
        r = table.reach
        rows += [
            (plan.device.name, cells, i, j, a[r + j, r + i])
            for j in range(r + 1) for i in range(r + 1)
        ]  # fmt: skip
    return Table(rows=rows, names=("device", "cells", "i", "j", "a"))


def main() -> None:
    """Simulate what is missing, one row each, and print what is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="itl_sta3800c")
    parser.add_argument("--flats", type=int, default=6)
    parser.add_argument("--level", type=float, default=80_000.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    path: Path = options.output
    plan = FlatPlan(Device.load(options.device), level=options.level, pixels=PIXELS)

    def rows() -> Table | None:
        return Table.read(path, format="ascii.ecsv") if path.exists() else None

    there = rows()
    done = set()
    if there is not None:
        done = set(there["flat"][there["device"] == plan.device.name])
    begin = time.monotonic()
    with open_executor("process", options.workers) as pool:
        numbers = [n for n in range(options.flats) if n not in done]
        spread = map if pool is None else pool.map
        for flat in spread(partial(simulate_flat, plan), numbers):
            row, there = reduce_flat(plan, flat), rows()
            if there is not None:
                row = vstack([there, row], metadata_conflicts="silent")
            write_results(row, path, COMMAND, added=True)
            print(f"flat {flat.number}: {flat.cpu_seconds:.0f} CPU s, "
                  f"{time.monotonic() - begin:.0f} s in all", flush=True)  # fmt: skip
    tables = path.with_name(f"{path.stem}_tables.ecsv")
    if not tables.exists():
        write_results(predict_responses(plan), str(tables), COMMAND)
    table = Table.read(path, format="ascii.ecsv")
    table = table[table["device"] == plan.device.name]
    half = PIXELS // 2 + 1
    a = np.array(table["response"]).reshape(-1, half, half)
    error = a.std(axis=0, ddof=1) / np.sqrt(len(a))
    print(f"{plan.device.name}: {len(a)} flats, a_ij [1e-8 / e-]")
    for j, i in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):
        print(f"  ({i},{j}) {1e8 * a.mean(0)[j, i]:9.3f} +- {1e8 * error[j, i]:.3f}")


if __name__ == "__main__":
    main()
