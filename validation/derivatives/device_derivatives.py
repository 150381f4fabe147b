"""Derivatives of the response by every uncertain quantity of a device, and the emulator.

``python -m validation.derivatives.device_derivatives derivatives`` holds derivatives of edge shifts
from the linearised solve against differences of solutions 0.1 spreads to either side on a mesh that
moves with the device, and 0.5 spreads to either side on meshes of their own, with what they cost.
``python -m validation.derivatives.device_derivatives emulator`` builds the emulator and holds it against
solutions at random points of the prior volume.  Rows replace those of the same device, mesh and
points in ``validation/results``.
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor import Device
from bfsensor.device.parameters import change_parameter, device_parameters
from bfsensor.errors import DeviceError
from bfsensor.response.edge_response import (
    REFINE_Z,
    EdgeResponse,
    area_matrix,
    solve_response,
)
from bfsensor.response.emulator import DeviceEmulator
from bfsensor.response.emulator_nodes import STEP
from validation.common.run_header import commit_here
from validation.common.write_results import replace_run

RESULTS = Path(__file__).parents[1] / "results" / "device_derivatives.ecsv"
COMMAND = "python -m validation.derivatives.device_derivatives"
NEAR, FAR = 0.1, 0.5
"""To either side, on the moved mesh and on others [spread]."""

MADE_ALIKE = ("device", "cells", "refine_z")

LAGS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))


def differences(
    device: Device, name: str, step: float, mesh: dict[str, int], remeshed: bool
) -> NDArray[np.float64]:
    """Change of the shifts for a unit, from solutions to either side or to the one there is."""
    sides: list[tuple[float, EdgeResponse]] = []
    for by in (step, -step):
        try:
            there = change_parameter(device, name, by)
        except DeviceError:
            continue
        sides.append((by, solve_response(
            there, laid_for=None if remeshed else device, **mesh,
        )))  # fmt: skip
    if len(sides) == 1:
        sides.append((0.0, solve_response(device, **mesh)))
    (a, one), (b, other) = sides
    return np.stack([one.kx - other.kx, one.ky - other.ky])[:, -1] / (a - b)


def compare_derivatives(
    device: Device, cells: int, refine_z: int, names: tuple[str, ...] = ()
) -> Table:
    """One row a parameter: errors of the derivatives, and what they are at the nearest lags."""
    known = {k: s for k, s in device_parameters(device).items() if not names or k in names}
    mesh = {"cells": cells, "refine_z": refine_z}
    changed = []
    for name, spread in known.items():
        step = STEP * spread
        try:
            changed.append((change_parameter(device, name, step), step))
        except DeviceError:
            changed.append((change_parameter(device, name, -step), -step))
    solve_response(device, cells=8, changed=changed[:1])  # kernels are compiled
    found = solve_response(device, changed=changed, **mesh)
    a = area_matrix(found.kx[-1], found.ky[-1])
    rows = []
    for n, (name, spread) in enumerate(known.items()):
        own = np.stack([found.dkx[n, -1], found.dky[n, -1]])

        def error(by: float, remeshed: bool, name=name, spread=spread, own=own) -> float:
            wanted = differences(device, name, by * spread, mesh, remeshed)
            return float(np.sqrt(np.sum((own - wanted) ** 2) / np.sum(wanted**2)))

        middle = np.s_[5:8, 5:8]
        change = (area_matrix(*own)[middle] * spread) / a[middle]
        row = {
            "device": device.name, **mesh, "parameter": name, "spread": spread,
            "error_moved": round(error(NEAR, False), 5),
            "error_remeshed": round(error(FAR, True), 5),
            **{f"change_{i}{j}": round(float(change[j, i]), 5) for i, j in LAGS},
            "solve_s": round(found.seconds[0], 2), "derivatives_s": round(found.seconds[1], 2),
        }  # fmt: skip
        rows.append(row)
        click.echo(
            f"{name:38s} {100 * row['error_moved']:6.2f} %"
            f"  own mesh {100 * row['error_remeshed']:6.2f} %  a_00 {100 * row['change_00']:+.2f} %"
        )
    ratio = found.seconds[1] / found.seconds[0]
    click.echo(
        f"all {len(rows)} derivatives: {ratio:.1f} solves of {found.seconds[0]:.2f} CPU s"
    )
    return Table(rows)


def check_emulator(
    device: Device,
    cells: int,
    refine_z: int,
    points: int,
    keep: Path | None,
    remeshed: bool,
) -> Table:
    """One row a lag: error of the emulator at random points, and what the prior leaves open."""
    began = time.process_time()
    # The version alone does not tell solutions of one commit from those of another.
    kept = keep and keep / commit_here()
    emulator = DeviceEmulator.build(device, cells=cells, refine_z=refine_z, keep=kept)
    built = time.process_time() - began
    check = emulator.check(points, 20_260, remeshed=remeshed)
    median, most = check.quantile(0.5), check.quantile(0.95)
    spread = check.solved.std(axis=0, ddof=1) / np.abs(check.solved.mean(axis=0))
    nominal = emulator.predict(emulator.nominal).areas
    rows = [
        {
            "device": device.name, "cells": cells, "refine_z": refine_z,
            "parameters": len(emulator.parameters),
            "points": points, "remeshed": remeshed, "i": i, "j": j, "a": float(nominal[j, i]),
            "prior_spread": round(float(spread[j, i]), 5),
            "error_median": round(float(median[j, i]), 5),
            "error_95": round(float(most[j, i]), 5), "unsolved": check.unsolved,
            "build_cpu_s": round(built, 1),
        }
        for j in range(nominal.shape[0]) for i in range(nominal.shape[1])
    ]  # fmt: skip
    for row in rows:
        click.echo("({i},{j}) a {a:+.3e}  prior {prior_spread:.4f}  median {error_median:.4f}  "
                   "95 % {error_95:.4f}".format(**row))  # fmt: skip
    click.echo(f"built in {built:.0f} CPU s (what was kept took none)")
    return Table(rows)


def put_results(table: Table, path: Path, run: tuple[str, ...]) -> None:
    """Write rows in place of those that were made alike: with equal columns ``run``."""
    replace_run(table, path, COMMAND, {name: table[name][0] for name in run}, {})


@click.group(help=__doc__)
def main() -> None:
    """Choose what to run."""


@main.command()
@click.option("--device", "names", multiple=True, default=("itl_sta3800c", "e2v_ccd250"))
@click.option("--cells", default=16, show_default=True)
@click.option("--refine-z", default=REFINE_Z, show_default=True)
@click.option("--parameter", "parameters", multiple=True,
              help="Printed only.  By default all, which are written.")  # fmt: skip
def derivatives(
    names: tuple[str, ...], cells: int, refine_z: int, parameters: tuple[str, ...]
) -> None:
    """Hold derivatives against differences."""
    for name in names:
        rows = compare_derivatives(Device.load(name), cells, refine_z, parameters)
        if not parameters:
            put_results(rows, RESULTS, MADE_ALIKE)


@main.command()
@click.option("--device", "names", multiple=True, default=("itl_sta3800c", "e2v_ccd250"))
@click.option("--cells", default=16, show_default=True)
@click.option("--refine-z", default=REFINE_Z, show_default=True)
@click.option("--points", default=20, show_default=True)
@click.option(
    "--keep",
    type=click.Path(path_type=Path),
    help="Folder of finished solutions, by commit.",
)
@click.option("--remeshed", is_flag=True, help="Solve every point on a mesh of its own.")
def emulator(
    names: tuple[str, ...],
    cells: int,
    refine_z: int,
    points: int,
    keep: Path | None,
    remeshed: bool,
) -> None:
    """Hold the emulator against solutions."""
    path = RESULTS.with_name("device_emulator.ecsv")
    for name in names:
        rows = check_emulator(Device.load(name), cells, refine_z, points, keep, remeshed)
        put_results(rows, path, (*MADE_ALIKE, "points", "remeshed"))


if __name__ == "__main__":
    main()
