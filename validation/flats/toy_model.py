"""Darts against the closed forms of the toy model, beside the formula of the seed paper.

``python -m validation.flats.toy_model [--realisations N] [--arrays N] [-o FOLDER]`` throws darts at
two pixels with a moving partition, 20 values of alpha at 10,000 and 50,000 e- a pixel with
100,000 trials each, as in the appendix of Lage, Bradshaw & Tyson (2017), into
``validation/results/toy_model.ecsv``; and at arrays of pixels into ``toy_array.ecsv``.  Rows
that are there already are not made again.  Some ten minutes on one core.

The paper does not say which values of alpha.  Here alpha times the level goes to 0.1 and 0.5:
a real sensor has 0.01 to 0.04 for its nearest neighbours at 100,000 e-, and 0.2 in the middle.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

from bfsensor import DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.measure.toy import (
    measure_pair,
    predict_pair,
    predict_pair_as_printed,
    throw_at_pair,
)
from bfsensor.measure.toy_array import (
    close_sum,
    measure_array,
    predict_array,
    throw_at_array,
)
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results"
COMMAND = "python -m validation.flats.toy_model"
ALPHAS = tuple(5e-7 * (k + 1) for k in range(20))
LEVELS = (10_000.0, 50_000.0)
MOMENTS = ("mean", "variance", "covariance")

DEVICE = "e2v_ccd250"
STRENGTH = 250.0
"""Times the table's a-matrix: as many times fewer electrons have the same effect."""
ARRAY_LEVELS = (100.0, 200.0, 300.0, 400.0)
SIZE = 8


def table_lags(*, reach: int = 2) -> NDArray[np.float64]:
    """The table's a-matrix [1/e-] of an empty array at the back surface, its sum closed."""
    table = DistortionTable.read(tables_dir() / DEVICE / "table.fits")
    charge = 100.0
    changes = table.area_changes(charge=charge, depth=float(table.depths[-1]))
    inner = slice(table.reach - reach, table.reach + reach + 1)
    area = table.pitch[0] * table.pitch[1]
    return close_sum(changes[inner, inner] / (charge * area))


def pair_row(alpha: float, level: float, realisations: int, seed: int) -> dict[str, Any]:
    """One value of alpha: darts, closed form, printed formula, and pulls of both."""
    began = time.process_time()
    charges = throw_at_pair(alpha, level, realisations=realisations, seed=seed)
    measured, errors = measure_pair(charges)
    row = {"alpha": alpha, "level": level, "realisations": realisations, "seed": seed}
    theory, printed = predict_pair(alpha, level), predict_pair_as_printed(alpha, level)
    for name in MOMENTS:
        found, error = getattr(measured, name), getattr(errors, name)
        row |= {name: found, f"{name}_error": error}
        for label, model in (("theory", theory), ("printed", printed)):
            value = float(getattr(model, name))
            row |= {
                f"{name}_{label}": value,
                f"{name}_{label}_pull": (found - value) / error,
            }
    return row | {"cpu_s": round(time.process_time() - began, 1)}


def array_row(level: float, realisations: int, seed: int) -> dict[str, Any]:
    """One level of an array: covariances by lag [j, i] of darts and of the closed form."""
    began = time.process_time()
    a = STRENGTH * table_lags()
    charges = throw_at_array(a, level, size=SIZE, realisations=realisations, seed=seed)
    measured, errors = measure_array(charges, level)
    theory = predict_array(a, level, size=SIZE)
    row = {"device": DEVICE, "strength": STRENGTH, "level": level, "size": SIZE}
    row |= {"realisations": realisations, "seed": seed}
    for name, values in (("measured", measured), ("error", errors), ("theory", theory)):
        row[name] = values.ravel()
    return row | {"cpu_s": round(time.process_time() - began, 1)}


def append(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a file of results, made if it is not there."""
    one = Table({name: [value] for name, value in row.items()})
    there = [Table.read(path, format="ascii.ecsv")] if path.exists() else []
    rows = vstack([*there, one], metadata_conflicts="silent")
    write_results(rows, path, COMMAND, added=True)


def seeds_of(path: Path) -> set[int]:
    """Seeds of the rows that are there."""
    return set(Table.read(path, format="ascii.ecsv")["seed"]) if path.exists() else set()


def main() -> None:
    """Throw what is missing, one row each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--realisations", type=int, default=100_000)
    parser.add_argument("--arrays", type=int, default=20_000)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    pairs, arrays = options.output / "toy_model.ecsv", options.output / "toy_array.ecsv"
    for n, level in enumerate(LEVELS):
        for k, alpha in enumerate(ALPHAS):
            # One seed a row: rows of one seed would share random numbers.
            seed = 52_100 + 100 * n + k
            if seed in seeds_of(pairs):
                continue
            row = pair_row(alpha, level, options.realisations, seed)
            append(pairs, row)
            pulls = "  ".join(
                f"{name} {row[name + '_theory_pull']:5.2f}" for name in MOMENTS
            )
            print(
                f"alpha {alpha:.1e} level {level:.0f}: {pulls}  {row['cpu_s']} s",
                flush=True,
            )
    for n, level in enumerate(ARRAY_LEVELS):
        seed = 81_700 + n
        if seed in seeds_of(arrays):
            continue
        row = array_row(level, options.arrays, seed)
        append(arrays, row)
        pull = (row["measured"] - row["theory"]) / row["error"]
        print(
            f"array level {level:.0f}: rms pull {np.sqrt((pull**2).mean()):.2f}, largest "
            f"{np.abs(pull).max():.2f}  {row['cpu_s']} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
