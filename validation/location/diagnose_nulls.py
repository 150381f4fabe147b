"""Nulls: campaigns without any effect, their p-values, and what of them is a false alarm.

``python -m validation.location.diagnose_nulls [--count 300] [--size S] [--first SEED]`` takes
campaigns of the virtual sensor with all nuisances of real ones (device, gain, noise, lamp, pixels)
and no effect, electron by electron in memory, diagnoses each against the nominal device's baseline,
and appends a row to ``validation/results/diagnose_nulls.ecsv``; seeds that are there are not taken
again.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from astropy.stats import binom_conf_interval
from astropy.table import Table, vstack
from scipy.stats import kstest

from bfsensor.diagnose.data.measure_channels import measure_channels
from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.fit.baseline_fit import fit_baseline
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "diagnose_nulls.ecsv"
COMMAND = "python -m validation.location.diagnose_nulls"
WORDS = ("flat_cov", "flat_mean", "flat_map", "serial_overscan", "parallel_overscan", "bias_cov",
         "bias_level", "dark_map", "spot", "amp_cross", "code_hist")  # fmt: skip


def diagnose_null(seed: int, size: str) -> Table:
    """One campaign, one row."""
    begin = time.process_time()
    source = VirtualSource(seed=seed, size=size)
    measured = measure_channels(source)
    predictor = Predictor(measured, virtual_baseline())
    fit = fit_baseline(predictor, used_channels(measured.channels, ("fit", "select")))
    found = locate_mismatch(fit, seed=seed)
    row = {"seed": seed, "size": size, "p": found.p_value, "p_chi2": found.p_chi2,
           "p_scans": found.p_scans}  # fmt: skip
    for word in WORDS:
        square, dof = found.chi2.get(word, (np.nan, np.nan))
        row |= {word: round(square, 2), f"{word}_dof": round(dof, 2)}
    row["pull_rms"] = round(float(np.sqrt(np.mean(np.square(list(fit.pulls.values()))))), 3)
    first = found.findings[0] if found.findings else None
    row["found"] = f"{first.word}: {first.family} {first.where}" if first else ""
    row["cpu_s"] = round(time.process_time() - begin, 1)
    return Table({k: [v] for k, v in row.items()})


def summarise(table: Table) -> None:
    """Print the distribution of p-values and false alarms."""
    for name in ("p", "p_chi2", "p_scans"):
        p = np.array(table[name])
        text = f"{name:8s} KS against even: p = {kstest(p, 'uniform').pvalue:.3f}"
        for level in (0.01, 0.05):
            k = int((p < level).sum())
            low, high = binom_conf_interval(k, len(p), 0.95, interval="wilson")
            text += f"   below {level}: {k} of {len(p)} ({low:.3f} to {high:.3f})"
        print(text)
    for word in WORDS:
        ratio = np.array(table[word]).sum() / np.array(table[f"{word}_dof"]).sum()
        z = (np.array(table[word]) - np.array(table[f"{word}_dof"])) / np.sqrt(
            2 * np.array(table[f"{word}_dof"])
        )
        print(
            f"  {word:18s} chi2/dof {ratio:.3f}, deviates {z.mean():5.2f} +- {z.std():.2f}"
        )


def main() -> None:
    """Take what is missing and print what is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--first", type=int, default=10_000)
    parser.add_argument("--size", default="S")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    path: Path = options.output
    for seed in range(options.first, options.first + options.count):
        there = Table.read(path, format="ascii.ecsv") if path.exists() else None
        if there is not None and np.any(
            (there["seed"] == seed) & (there["size"] == options.size)
        ):
            continue
        row = diagnose_null(seed, options.size)
        print(
            f"{seed}: p = {row['p'][0]:.3g}, {row['cpu_s'][0]} CPU s {row['found'][0]}",
            flush=True,
        )
        if there is not None:
            there["found"] = there["found"].astype(object)
            row["found"] = row["found"].astype(object)
            row = vstack([there, row], metadata_conflicts="silent")
        row["found"] = row["found"].astype(str)
        write_results(row, path, COMMAND, added=True)
    summarise(Table.read(path, format="ascii.ecsv"))


if __name__ == "__main__":
    main()
