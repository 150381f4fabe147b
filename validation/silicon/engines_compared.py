"""Changes of a_ij between devices by two other engines beside those by our solver, lag by lag.

``python -m validation.silicon.engines_compared BINARY KEPT`` changes one quantity of ITL's device at a
time, solves both devices by both, and writes ``validation/results/engines_compared.ecsv``.  Poisson_CCD
takes a minute of CPU for a device; its a_ij go to the folder KEPT by the text of the configuration, and
what is there is not run again.  A row 'nothing' is the program's own noise: other random steps.
Rows with image charges under 'numerics' hold that engine's changes, of what it has, as 'theirs'.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.device.quantities import quantities
from bfsensor.errors import BFSensorError
from bfsensor.response.edge_response import area_matrix, solve_response
from validation.common.write_results import RESULTS, write_results
from validation.silicon.other_engine import Run, area_changes, configuration
from validation.silicon.truths import GATES, IMAGE_CHARGE, LEVEL, by_image_charges, changed

Array = NDArray[np.float64]
DEVICE = "itl_sta3800c"
CELLS = 32
"""Cells a pixel of our solver.  Chosen: on 48 a_ij differ by 0.4 %, their changes by less."""
LAGS = ((0, 0), (1, 0), (0, 1), (1, 1))
"""Lags in x and y of the rows: those that the program resolves each by itself."""
CHANGES = (
    ("silicon.background_doping", 2.3976), ("operating_point.back_bias", 5.0),
    ("silicon.thickness", 10.0), ("channel_stop.implant[0].dose", -13500.0),
    ("channel.implant[1].peak", 0.15), ("operating_point.hole_quasi_fermi_level", 1.5),
    ("channel.surface_charge", 3000.0), ("gates.gate_oxide", 0.03), (GATES, -1.0),
    ("channel.implant[1].dose", 1500.0), ("operating_point.gate_high", 1.0),
    ("channel_stop.width", 0.9), ("channel_stop.implant[0].peak", 0.15),
)  # fmt: skip
"""Quantities and their changes [internal unit].  Chosen: three uncertainties of the device's file (a
doping that is all but gone), and of voltages and thickness what laboratories set or know least; with
twice the change a_ij are less linear in it, in both."""
NUMERICS = {
    "": Run(reach=1), "other steps": Run(reach=1, seed=5),
    "w 1.8, 128 sweeps": Run(reach=1, relaxation=1.8, cycles=128),
    "w 1.8, 512 sweeps": Run(reach=1, relaxation=1.8, cycles=512),
    "half the excess": Run(reach=1, excess=20_000.0),
}  # fmt: skip
"""Runs: with the truths' settings, with other random steps, with the published iteration and four times
as many sweeps, and with half the charge above the background."""

BLUE = 400.0
"""Wavelength [nm] of light by image charges.  Published: it is absorbed within 0.3 um of the back
surface, where the others' light converts; at 500 nm (1.5 um) changes differ by less than 0.01 %."""


def ours(kept: Path, device: Device) -> Array:
    """a_ij [1/e-] by our solver for light that converts at the back surface, indices [j, i]."""

    def solve() -> tuple[Array, float]:
        before = time.process_time()
        found = solve_response(device, level=LEVEL, cells=CELLS)
        whole = area_matrix(found.kx[-1], found.ky[-1])
        n = len(whole) // 2
        return whole[n : n + 2, n : n + 2], time.process_time() - before

    return _once(_place(kept, f"{CELLS} cells, {LEVEL} e-\n{device.physics}"), solve)[0]


def theirs(binary: Path, kept: Path, device: Device, run: Run) -> tuple[Array, float]:
    """a_ij [1/e-] by the program, indices [j, i], and CPU time [s]."""
    place = _place(kept, configuration(device, run))
    return _once(place, lambda: area_changes(binary, device, run))


def _place(kept: Path, text: str) -> Path:
    """File of what was solved for a text."""
    return kept / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"


def _once(path: Path, solve: Callable[[], tuple[Array, float]]) -> tuple[Array, float]:
    """a_ij and CPU time of a file, which is made if it is not there."""
    if not path.exists():
        a, cpu_s = solve()
        path.write_text(json.dumps({"a": a.tolist(), "cpu_s": cpu_s}))
    found = json.loads(path.read_text())
    return np.array(found["a"]), float(found["cpu_s"])


def rows_of(
    device: Device, change: dict[str, float], first: tuple[Array, Array], last: tuple[Array, Array],
    numerics: str, cpu_s: float,
) -> list[dict[str, Any]]:  # fmt: skip
    """Rows of a change, given our and the program's a_ij before and after."""
    (name, by), *_ = change.items() if change else [("nothing", 0.0)]
    known = quantities(device).get(name)
    out = []
    for i, j in LAGS:
        ratio = [b[j, i] / a[j, i] - 1 for a, b in zip(first, last, strict=True)]
        out.append(
            {
                "quantity": name, "by": known.number(by) if known else by,
                "unit": known.unit if known else "", "i": i, "j": j,
                "ours": round(100 * ratio[0], 3), "theirs": round(100 * ratio[1], 3),
                "numerics": numerics, "cpu_s": round(cpu_s, 1),
            }
        )  # fmt: skip
    return out


@click.command()
@click.argument("binary", type=click.Path(path_type=Path))
@click.argument("kept", type=click.Path(path_type=Path))
@click.option(
    "--only-kept", is_flag=True, help="Leave out what the program has not solved."
)
def main(binary: Path, kept: Path, only_kept: bool) -> None:
    """Write changes by both."""
    kept.mkdir(parents=True, exist_ok=True)
    device = Device.load(DEVICE)
    own = ours(kept, device)
    rows: list[dict[str, Any]] = []
    wanted: list[tuple[dict[str, float], str]] = [({name: by}, "") for name, by in CHANGES]
    for numerics in NUMERICS:
        wanted += [({}, numerics)] if numerics else []
        wanted += [(dict(CHANGES[:1]), numerics)] if "sweeps" in numerics else []
    for change, numerics in wanted:
        other = changed(device, change)
        run = NUMERICS[numerics]
        base = NUMERICS[numerics if change else ""]
        if only_kept and not all(
            (
                kept
                / f"{hashlib.sha256(configuration(d, r).encode()).hexdigest()[:16]}.json"
            ).exists()
            for d, r in ((device, base), (other, run))
        ):
            continue
        try:
            after = ours(kept, other) if change else own
        except BFSensorError as error:
            click.echo(f"{change}: {error}")
            continue
        before, _ = theirs(binary, kept, device, base)
        last, cpu_s = theirs(binary, kept, other, run)
        rows += rows_of(device, change, (own, before), (after, last), numerics, cpu_s)
        click.echo("\n".join(json.dumps(row) for row in rows[-len(LAGS) :]))
    for name, by in CHANGES:
        if name in IMAGE_CHARGE:
            ratio = by_image_charges(device, {name: by}, BLUE)
            after = ours(kept, changed(device, {name: by}))
            both = (own, np.ones((2, 2))), (after, ratio[:2, :2])
            rows += rows_of(device, {name: by}, *both, "image charges", 0.0)
    table = Table(rows)
    for name in ("ours", "theirs"):
        table[name].unit = "percent"
    write_results(
        table, RESULTS / "engines_compared.ecsv",
        "python -m validation.silicon.engines_compared BINARY KEPT",
        cpu_s=float(sum({(r["quantity"], r["numerics"]): r["cpu_s"] for r in rows}.values())),
    )  # fmt: skip


if __name__ == "__main__":
    main()
