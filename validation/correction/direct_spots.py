"""Corrected spots of the direct simulation: another engine than the table's sensor.

``python -m validation.correction.direct_spots FOLDER [--device itl_sta3800c]`` reads the spots that
``bfsensor spots DEVICE --peak 100000 --steps 40 -o FOLDER`` built up electron by electron, in the field
of the charge that had been collected, and corrects them with the device's table.  Their light converts
5 um below the back surface, where shifts are those of the surface within 1e-3.  A row an axis and
correction: growth of the second moments before, and what is left of it, with the error by the scatter
among spots.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.direct.spot_exposure import Spot
from bfsensor.measure.correct import correct_edges, correct_kernel
from bfsensor.sensor.table_correction import correct_table
from bfsensor.table.lsst_format import solve_kernel
from bfsensor.table.quadrant_shifts import quadrant_shifts
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "direct_spots.ecsv"
COMMAND = "python -m validation.correction.direct_spots FOLDER"


def moments(image: NDArray) -> NDArray:
    """Second moments in x and y [pixel^2]."""
    at = np.arange(len(image)) - len(image) // 2
    out = []
    for profile in (image.sum(0), image.sum(1)):
        mean = profile @ at / profile.sum()
        out.append(profile @ (at - mean) ** 2 / profile.sum())
    return np.array(out)


def corrected(image: NDArray, table: DistortionTable) -> dict[str, NDArray]:
    """Correct an image every way."""
    shifts = quadrant_shifts(table, tail_slope=None)
    return {
        "none": image,
        "table": correct_table(image, table, surroundings="none"),
        "kernel": correct_kernel(image, solve_kernel(shifts.areas)),
        "edges": correct_edges(image, *shifts),
    }


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
@click.option("--device", default="itl_sta3800c")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS)
def main(folder: Path, device: str, output: Path) -> None:
    """Correct, print, write."""
    table = DistortionTable.read(tables_dir() / device / "table.fits")
    spots = [Spot.read(path) for path in sorted(folder.glob("spot_*.fits"))]
    growths: dict[str, list[NDArray]] = {}
    for spot in spots:
        on, off = (np.asarray(a[-1], float) for a in (spot.on, spot.off))
        without = moments(off)
        for name, image in corrected(on, table).items():
            growths.setdefault(name, []).append(moments(image) / without - 1)
    rows = []
    before = np.array(growths["none"])
    for name, found in growths.items():
        after = np.array(found)
        share = after.mean(0) / before.mean(0)
        scatter = np.std(after - share * before, axis=0, ddof=1) / np.sqrt(len(spots))
        for n, axis in enumerate("xy"):
            rows.append({
                "device": device, "spots": len(spots), "correction": name, "axis": axis,
                "growth": 100 * before[:, n].mean(), "left": 100 * share[n],
                "error": 100 * scatter[n] / before[:, n].mean(),
            })  # fmt: skip
            print(f"{name:8} {axis}: {100 * share[n]:+.2f} +- {rows[-1]['error']:.2f} % of a growth by "
                  f"{rows[-1]['growth']:.3f} %")  # fmt: skip
    made = Table(rows=rows)
    if output.exists():
        old = Table.read(output, format="ascii.ecsv")
        made = vstack([old[old["device"] != device], made], metadata_conflicts="silent")
    write_results(made, output, COMMAND, added=True)


if __name__ == "__main__":
    main()
