"""Covariances of flats that the areas of our tables predict, beside measured ones.

``python -m validation.flats.covariances REFERENCE`` solves each setting for three questions: one pixel
with 80,000 e- among empty ones (the seed paper's areas, A(Q) / Q), one with 10,000 e- (the
limit of weak flats), and one 10,000 e- above its neighbours about 40,000 e- (the differential
response in the middle of a flat of 80,000 e-).  REFERENCE is the folder with
``seed_fig9_covariance_80ke.csv`` and ``*_covariances_21oct19.csv``.  Nothing is fitted.  One row
a setting and lag goes to ``validation/results/covariances.ecsv``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from astropy.io import ascii as tables
from astropy.table import Table, vstack

from bfsensor import Device, build_table, plan_table
from validation.common.write_results import write_results

SETTINGS = {
    # name: device, changed values, file, condition in it
    "seed A": ("itl_sta3800c", {"back_bias": "-60 V", "gate_high": "4 V"}, "seed", "A"),
    "seed B": ("itl_sta3800c", {"back_bias": "-30 V", "gate_high": "4 V"}, "seed", "B"),
    "seed C": (
        "itl_sta3800c",
        {"back_bias": "-60 V", "gate_high": "6 V", "gate_low": "-6 V"},
        "seed",
        "C",
    ),
    "itl_sta3800c_60": ("itl_sta3800c_60", {}, "itl", ""),
    "itl_sta3800c": ("itl_sta3800c", {}, "itl", ""),
    "e2v_ccd250_70": ("e2v_ccd250_70", {}, "e2v", ""),
    "e2v_ccd250": ("e2v_ccd250", {}, "e2v", ""),
}
LEVEL = 80_000.0
QUESTIONS = {"full": (80e3, 0.0), "weak": (10e3, 0.0), "middle": (45e3, 35e3)}


def read_measured(folder: Path, kind: str, condition: str) -> dict[tuple[int, int], tuple]:
    """Measured covariance per electron, its error, and the published prediction, by (x, y)."""
    if kind == "seed":
        rows = tables.read(folder / "seed_fig9_covariance_80ke.csv", comment="#")
        rows = rows[rows["condition"] == condition]
        return {
            (int(r["xlag"]), int(r["ylag"])): tuple(
                float(np.ma.filled(r[name], np.nan)) / LEVEL
                for name in ("meas_cov", "meas_err_upper_over_2", "sim_dA_over_A")
            )
            for r in rows
        }
    rows = tables.read(folder / f"{kind}_covariances_21oct19.csv", comment="#")
    published = tables.read(
        folder / f"poisson_ccd_repo_pixel-{kind}_sim_area_cov.csv", comment="#"
    )
    sim = {(int(r[0]), int(r[1])): float(r[2]) for r in published}
    return {
        (int(r["i_serial"]), int(r["j_parallel"])): (
            float(r["cov_per_e"]), float(r["err_per_e"]),
            sim.get((int(r["i_serial"]), int(r["j_parallel"])), np.nan),
        )
        for r in rows
    }  # fmt: skip


def predict(device: Device) -> dict[str, np.ndarray]:
    """Area change per electron [nominal area] by lag [y, x] for each question."""
    charges = sorted({q for q, _ in QUESTIONS.values()})
    backgrounds = sorted({b for _, b in QUESTIONS.values()})
    table = build_table(
        plan_table(device, charges=charges, backgrounds=backgrounds, depths=[50.0, 95.0])
    )
    area = table.pitch[0] * table.pitch[1]
    r = table.reach
    out = {}
    for name, (q, b) in QUESTIONS.items():
        change = table.area_changes(charge=q, background=b, depth=95.0) / area / (q - b)
        out[name] = change[r:, r:]
    return out


def main() -> None:
    """Solve what is missing and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--only", help="one setting")
    parser.add_argument("-o", "--output", default="validation/results/covariances.ecsv")
    options = parser.parse_args()
    path = Path(options.output)
    done = Table.read(path, format="ascii.ecsv") if path.exists() else None
    for name, (device_name, changes, kind, condition) in SETTINGS.items():
        if (options.only and options.only != name) or (
            done is not None and name in done["setting"]
        ):
            continue
        device = Device.load(device_name)
        for key, value in changes.items():
            device = device.with_value(key, value)
        begin = time.process_time()
        found = predict(device)
        cpu = time.process_time() - begin
        rows = []
        for (i, j), (value, error, published) in sorted(
            read_measured(options.reference, kind, condition).items()
        ):
            if max(i, j) >= len(found["full"]):
                continue
            rows.append((name, i, j, value, error, published,
                         *(float(found[q][j, i]) for q in QUESTIONS), round(cpu, 1)))  # fmt: skip
        new = Table(rows=rows, names=("setting", "x", "y", "measured", "error", "published",
                                      *QUESTIONS, "cpu_s"))  # fmt: skip
        done = new if done is None else vstack([done, new], metadata_conflicts="silent")
        write_results(
            done, path, "python -m validation.flats.covariances REFERENCE", added=True
        )
        print(f"{name}: {cpu:.0f} CPU s; 1e-8 per electron")
        for row in new:
            if row["x"] <= 2 and row["y"] <= 2:
                numbers = "  ".join(
                    f"{1e8 * row[q]:9.3f}" for q in ("published", *QUESTIONS)
                )
                print(
                    f"  ({row['x']},{row['y']})  measured {1e8 * row['measured']:9.3f} +- "
                    f"{1e8 * row['error']:.3f}  published, full, weak, middle {numbers}  "
                    f"pull {(row['middle'] - row['measured']) / row['error']:6.1f}"
                )


if __name__ == "__main__":
    main()
