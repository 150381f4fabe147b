"""Our tables beside GalSim's shipped ones, and beside published runs.

``python -m validation.boundaries.compare_published [-o OUT.ecsv]`` prints area changes per 100,000
e- lag by lag.  The published areas are those printed in figures: [1] Lage, Bradshaw & Tyson 2017,
figure 7 (80,000 e-, -60 V, gates -8/+4 V, doping of 2017); [2] Poisson_CCD, data/pixel-itl and
pixel-e2v, commit fc8a083 (100,000 e-).
"""

from __future__ import annotations

import argparse

import galsim
import numpy as np
from astropy.table import Table

from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.table.build import build_table
from bfsensor.table.galsim_format import read_galsim
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import plan_table
from validation.common.write_results import write_results

LAGS = (
    (0, 0),
    (1, 0),
    (0, 1),
    (1, 1),
    (2, 0),
    (0, 2),
    (2, 1),
    (1, 2),
    (2, 2),
    (3, 0),
    (0, 3),
    (3, 3),
)

PUBLISHED_AREAS = {
    "itl_sta3800c_60": {
        (0, 0): 90.8519, (1, 0): 100.749, (0, 1): 101.6726, (1, 1): 100.3362, (2, 0): 100.0996,
        (0, 2): 100.1204, (2, 1): 100.0749, (1, 2): 100.0823, (2, 2): 100.0415,
    },
    "e2v_ccd250_70": {
        (0, 0): 83.9885, (1, 0): 100.8626, (0, 1): 102.6025, (1, 1): 100.6411, (2, 0): 100.2146,
        (0, 2): 100.246, (2, 1): 100.1654, (1, 2): 100.1741, (2, 2): 100.0923,
    },
    "seed paper, figure 7": {(0, 0): 87.3876, (1, 0): 100.5357, (0, 1): 101.5263, (1, 1): 100.2833},
}  # fmt: skip
"""Areas [um^2], means of symmetric pixels (sources in the module's docstring)."""


def changes(
    table: DistortionTable, charge: float, depth: float
) -> dict[tuple[int, int], float]:
    """Area changes [um^2] by lag, symmetric pixels averaged."""
    a = table.area_changes(charge=charge, depth=depth)
    r = table.reach
    return {
        (i, j): float(np.mean([a[r + s * j, r + t * i] for s in (1, -1) for t in (1, -1)]))
        for i, j in LAGS
    }


def main() -> None:
    """Print the comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    rows = []
    share = f"{galsim.meta_data.share_dir}/sensors"
    for name, stem in (
        ("itl_sta3800c", "lsst_itl_50_32"),
        ("e2v_ccd250", "lsst_e2v_50_32"),
    ):
        ours = changes(DistortionTable.read(tables_dir() / name / "table.fits"), 1e5, 95.0)
        theirs = changes(read_galsim(f"{share}/{stem}"), 1e5, 95.0)
        rows += [_row(name, stem, lag, ours[lag], theirs[lag]) for lag in LAGS]
    for name in ("itl_sta3800c_60", "e2v_ccd250_70"):
        ours = changes(DistortionTable.read(tables_dir() / name / "table.fits"), 1e5, 95.0)
        published = PUBLISHED_AREAS[name]
        rows += [
            _row(name, "published run [2]", lag, ours[lag], published[lag] - 99.9974)
            for lag in published
        ]
    seed = Device.load("itl_sta3800c_60").with_operating_point(gate_high="4 V")
    table = build_table(
        plan_table(seed, charges=[8e4], backgrounds=[0.0], depths=[95.0], accuracy=0.01)
    )
    ours = changes(table, 8e4, 95.0)
    published = PUBLISHED_AREAS["seed paper, figure 7"]
    rows += [
        _row(
            "itl at -60 V, +4 V, 80 ke-",
            "figure 7 [1]",
            lag,
            ours[lag],
            published[lag] - 100,
        )
        for lag in published
    ]
    result = Table(rows)
    print("\n".join(result.pformat(max_lines=-1, max_width=-1)))
    if args.output:
        write_results(
            result, args.output, "python -m validation.boundaries.compare_published"
        )


def _row(
    name: str, other: str, lag: tuple[int, int], ours: float, theirs: float
) -> dict[str, object]:
    return {
        "device": name, "beside": other, "i": lag[0], "j": lag[1], "ours_um2": round(ours, 4),
        "theirs_um2": round(theirs, 4), "ours/theirs": round(ours / theirs, 3),
    }  # fmt: skip


if __name__ == "__main__":
    main()
