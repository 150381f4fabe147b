"""B-F slopes of directly simulated spots at the three settings of the seed paper.

``python -m validation.spots.spot_slopes FOLDER [--spots 10] [--workers 2]`` builds up spots of 10 um to
130,000 e- in the peak in the ITL device (40 steps, 8 cells a pixel; some 70 CPU s a spot) at
Vbb, Vparallel = -60, +4/-8 (A), -30, +4/-8 (B) and -60, +6/-6 V (C), keeps them in FOLDER/A .. C, and
measures their growth with both weights of the forward model.  Spots that are there are not made
again.  Two slopes, both into ``validation/results/spot_slopes.ecsv``: the paper's, the width
[% of a pixel] against the mean charge of the central pixel over the 54,000 to 110,000 e- that its
figure 9 covers; and the relative one, the growth [% of the width] against the fitted peak up to
80,000 e-, a line through the origin.  Growth by level goes to ``spot_growth.ecsv``.

``--mesh FOLDER16`` compares instead: spots to 80,000 e- of setting A on 8 and on 16 cells a pixel,
from the same electrons, into ``spot_mesh.ecsv``.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from tqdm import tqdm

from bfsensor import Device
from bfsensor.direct.spot_exposure import Spot, SpotPlan, simulate_spot
from bfsensor.measure.growth import UNIT, Growth, measure_growth
from bfsensor.sweeps.executors import open_executor, run_points
from validation.common.write_results import write_results

SETTINGS = {
    "A": {"back_bias": "-60 V", "gate_high": "4 V", "gate_low": "-8 V"},
    "B": {"back_bias": "-30 V", "gate_high": "4 V", "gate_low": "-8 V"},
    "C": {"back_bias": "-60 V", "gate_high": "6 V", "gate_low": "-6 V"},
}
PEAK, STEPS = 130_000.0, 40
RANGE = (54e3, 110e3)
"""Charge of the central pixel [e-] that the published slopes were fitted to: refitting the
published simulation there gives its printed slopes."""


def plan_for(setting: str) -> SpotPlan:
    """Plan of one setting."""
    device = Device.load("itl_sta3800c")
    for key, value in SETTINGS[setting].items():
        device = device.with_value(key, value)
    return SpotPlan(device, peak=PEAK, steps=STEPS)


def measure(
    on: NDArray[np.integer], off: NDArray[np.integer], weights: str
) -> tuple[NDArray[np.float64], Growth, *tuple[tuple[NDArray, NDArray], ...]]:
    """Central charge by level, growth, and both slopes (x, y) with errors [% per 50,000 e-]."""

    def both(on: NDArray, off: NDArray) -> tuple[NDArray, NDArray, Growth, NDArray]:
        middle = on.shape[-1] // 2
        central = on[:, :, middle, middle].mean(0)
        found = measure_growth(on, off, weights=weights)
        # The width without the effect does not depend on the level; its noise is left out.
        width = found.sigma[-1] * found.growth / 100
        inside = (central >= RANGE[0]) & (central <= RANGE[1])
        paper = 100 * UNIT * np.polyfit(central[inside], width[inside], 1)[0]
        low = found.peak <= 80_500.0
        q, g = found.peak[low], found.growth[low]
        return paper, UNIT * (q @ g) / (q @ q), found, central

    whole = both(on, off)
    every = np.arange(len(on))
    parts = [both(on[every != n], off[every != n])[:2] for n in every]
    values = []
    for kind in (0, 1):
        left = np.array([part[kind] for part in parts])
        error = np.sqrt((len(on) - 1) * left.var(0))
        values.append((whole[kind], error))
    return whole[3], whole[2], *values


def compare_meshes(coarse: Path, fine: Path) -> None:
    """Relative slopes of the same spots on 8 and 16 cells a pixel, and their ratio."""
    plan = replace(plan_for("A"), peak=80_000.0)
    images = []
    for folder, cells in ((coarse, 8), (fine, 16)):
        key = replace(plan, cells=cells).key
        images.append(
            {p.stem[-4:]: Spot.read(p) for p in folder.glob(f"spot_{key}_*.fits")}
        )
    numbers = sorted(set(images[0]) & set(images[1]))
    levels = np.arange(1, STEPS, 2)
    arrays = [
        np.array([[getattr(i[n], name)[levels] for n in numbers] for name in ("on", "off")])
        for i in images
    ]
    rows = []
    for weights in ("equal", "noise"):

        def slope(a: NDArray, w: str = weights) -> NDArray:
            return measure_growth(a[0], a[1], weights=w).slope

        found = np.array([slope(a) for a in arrays])
        ratio = found[1] / found[0]
        keep = [np.arange(len(numbers)) != n for n in range(len(numbers))]
        parts = np.array([slope(arrays[1][:, k]) / slope(arrays[0][:, k]) for k in keep])
        error = np.sqrt((len(numbers) - 1) * parts.var(0))
        for n, axis in enumerate("xy"):
            rows.append((weights, axis, len(numbers), *found[:, n], ratio[n], error[n]))
            print(f"{weights:5s} {axis}: 8 cells {found[0, n]:.4f}, 16 cells {found[1, n]:.4f}, "
                  f"ratio {ratio[n]:.4f} +- {error[n]:.4f}, {len(numbers)} spots")  # fmt: skip
    names = ("weights", "axis", "spots", "slope_8", "slope_16", "ratio", "error")
    write_results(Table(rows=rows, names=names), "validation/results/spot_mesh.ecsv",
                  "python -m validation.spots.spot_slopes FOLDER --mesh FOLDER16")  # fmt: skip


def main() -> None:
    """Simulate what is missing, measure all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--spots", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--mesh", type=Path, metavar="FOLDER16")
    options = parser.parse_args()
    if options.mesh:
        compare_meshes(options.folder, options.mesh)
        return
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
        levels = np.arange(1, STEPS, 2)
        on, off = (np.array([getattr(s, n)[levels] for s in spots]) for n in ("on", "off"))
        cpu = round(sum(s.cpu_seconds for s in spots), 1)
        for weights in ("equal", "noise"):
            central, found, *values = measure(on, off, weights)
            for unit, (slope, error) in zip(("paper", "relative"), values, strict=True):
                for n, axis in enumerate("xy"):
                    row = (
                        setting,
                        weights,
                        unit,
                        axis,
                        len(spots),
                        slope[n],
                        error[n],
                        cpu,
                    )
                    slopes.append(row)
                    print(f"{setting} {weights:5s} {unit:8s} {axis}: {slope[n]:.4f} +- "
                          f"{error[n]:.4f} % per 50,000 e-, {len(spots)} spots")  # fmt: skip
            for n, axis in enumerate("xy"):
                for m, peak in enumerate(found.peak):
                    curve.append((setting, weights, axis, peak, central[m], found.sigma[m, n],
                                  found.growth[m, n], found.growth_error[m, n]))  # fmt: skip
    command = "python -m validation.spots.spot_slopes FOLDER"
    names = ("setting", "weights", "unit", "axis", "spots", "slope", "error", "cpu_s")
    write_results(
        Table(rows=slopes, names=names), "validation/results/spot_slopes.ecsv", command
    )
    names = ("setting", "weights", "axis", "peak", "central", "sigma", "growth", "error")
    write_results(
        Table(rows=curve, names=names), "validation/results/spot_growth.ecsv", command
    )


if __name__ == "__main__":
    main()
