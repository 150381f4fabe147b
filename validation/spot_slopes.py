"""B-F slopes of directly simulated spots at the three settings of the seed paper.

``python -m validation.spot_slopes FOLDER [--spots 16] [--workers 2]`` builds up spots of 10 um to
80,000 e- in the peak in the ITL device (40 steps, 8 cells a pixel; some 40 CPU s a spot) at
Vbb, Vparallel = -60, +4/-8 (A), -30, +4/-8 (B) and -60, +6/-6 V (C), keeps them in FOLDER/A .. C, and
measures their growth with both weights of the forward model.  Spots that are there are not made
again.  Slopes go to ``validation/results/spot_slopes.ecsv``, growth by level to
``spot_growth.ecsv``.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
from astropy.table import Table
from tqdm import tqdm

from bfsensor import Device
from bfsensor.measure.growth import measure_growth
from bfsensor.simulate.exposure import Spot, SpotPlan, simulate_spot
from bfsensor.sweep import open_executor, run_points
from validation.write_results import write_results

SETTINGS = {
    "A": {"back_bias": "-60 V", "gate_high": "4 V", "gate_low": "-8 V"},
    "B": {"back_bias": "-30 V", "gate_high": "4 V", "gate_low": "-8 V"},
    "C": {"back_bias": "-60 V", "gate_high": "6 V", "gate_low": "-6 V"},
}
STEPS = 40


def plan_for(setting: str) -> SpotPlan:
    """Plan of one setting."""
    device = Device.load("itl_sta3800c")
    for key, value in SETTINGS[setting].items():
        device = device.with_value(key, value)
    return SpotPlan(device, steps=STEPS)


def main() -> None:
    """Simulate what is missing, measure all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--spots", type=int, default=16)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    slopes, curve = [], []
    for setting in SETTINGS:
        plan = plan_for(setting)
        plan.check_full_well()  # here, that workers need not
        folder = options.folder / setting
        folder.mkdir(parents=True, exist_ok=True)
        bar = tqdm(total=options.spots, desc=setting, unit="spot", file=sys.stderr)

        def progress(done: int, total: int, bar: tqdm = bar) -> None:
            bar.n = done
            bar.refresh()

        def write(spot: Spot, path: Path) -> None:
            spot.write(path)

        with open_executor("process", options.workers) as pool:
            spots = run_points(
                partial(simulate_spot, plan), range(options.spots),
                path=lambda n, f=folder, k=plan.key: f / f"spot_{k}_{n:04d}.fits",
                read=Spot.read, write=write, executor=pool, progress=progress,
            )  # fmt: skip
        bar.close()
        levels = np.arange(STEPS // 8, STEPS + 1, STEPS // 8) - 1
        on, off = (np.array([getattr(s, n)[levels] for s in spots]) for n in ("on", "off"))
        for weights in ("equal", "noise"):
            found = measure_growth(on, off, weights=weights)
            for n, axis in enumerate("xy"):
                slopes.append((setting, weights, axis, len(spots), found.slope[n],
                               found.slope_error[n], found.sigma[-1, n],
                               round(sum(s.cpu_seconds for s in spots), 1)))  # fmt: skip
                print(f"{setting} {weights:5s} {axis}: {found.slope[n]:.4f} +- "
                      f"{found.slope_error[n]:.4f} % per 50,000 e-, {len(spots)} spots")  # fmt: skip
                for m, peak in enumerate(found.peak):
                    curve.append((setting, weights, axis, peak, found.growth[m, n],
                                  found.growth_error[m, n]))  # fmt: skip
    command = "python -m validation.spot_slopes FOLDER"
    names = ("setting", "weights", "axis", "spots", "slope", "error", "sigma", "cpu_s")
    write_results(
        Table(rows=slopes, names=names), "validation/results/spot_slopes.ecsv", command
    )
    names = ("setting", "weights", "axis", "peak", "growth", "error")
    write_results(
        Table(rows=curve, names=names), "validation/results/spot_growth.ecsv", command
    )


if __name__ == "__main__":
    main()
