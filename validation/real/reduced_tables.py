"""Departures of a measured table of a_ij, and what ``bfsensor diagnose`` says of each.

``python -m validation.real.reduced_tables`` takes the a_ij of an ITL sensor that LSST measured in
October 2019, as they are and changed in one way that a person knows the answer to, and calls the command
line on each file.  The cases are those of which an earlier version named what cannot be: powers of the
charge from a table of one level, a tail beyond the table where one value is off, an implant outside the
silicon.

Rows go to ``validation/results/reduced_tables.ecsv``.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bfsensor.device.condition import Condition
from bfsensor.diagnose.model.open_baseline import find_baseline
from validation.common.write_results import write_results

ROOT = Path(__file__).parents[2]
MEASURED = ROOT / "tests" / "data" / "itl_covariances_21oct19.csv"
RESULTS = ROOT / "validation" / "results" / "reduced_tables.ecsv"
COMMAND = "python -m validation.real.reduced_tables"
BASELINE = "itl_sta3800c_60"
FITTED = "itl_sta3800c_2019"
OWN_ERRORS = 0.19
"""Factor between the errors' own scatter at far lags and as stated: that of the fit of this table."""
DEEPER = 1.03
"""Factor on a_00.  Chosen: 3e-8, ten of its errors."""
MUCH_DEEPER = 1.2
"""Factor on a_00.  Chosen: 20e-8, eight of the errors that the card's freedom leaves it."""
WIDER = 1.6
"""Factor on lags of two pixels.  Chosen: 1e-8, ten of their errors."""


@dataclass(frozen=True)
class Case:
    """One table, how it is diagnosed, and what a person expects.

    Attributes
    ----------
    name : str
    errors : float
        Factor on the stated errors.
    near, two : float
        Factors on a_00, and on the values at lags of two pixels in x or y.
    baseline : str
    options : tuple of str
        Of the command line.
    null : bool
        Whether values are the baseline's own with noise of the errors, instead of the measured ones.
    expected : str
    """

    name: str
    errors: float = 1.0
    near: float = 1.0
    two: float = 1.0
    baseline: str = BASELINE
    options: tuple[str, ...] = ()
    null: bool = False
    expected: str = ""


STATED = ("--errors", "stated")
CASES = (
    Case("as measured", expected="what the card's uncertainty allows"),
    Case("errors as stated", options=STATED, expected="nothing: errors are wide"),
    Case("errors x 0.19", OWN_ERRORS, options=STATED,
         expected="lags of two pixels; no power of the charge"),
    Case("errors x 0.19, fitted device", OWN_ERRORS, baseline=FITTED, options=STATED,
         expected="nothing"),
    Case("the device's own values and noise", OWN_ERRORS, null=True, options=STATED,
         expected="nothing"),
    Case("lags of two pixels x 1.6", OWN_ERRORS, two=WIDER, options=STATED,
         expected="lags of two pixels; no power of the charge"),
    Case("a_00 3 % deeper", OWN_ERRORS, near=DEEPER, baseline=FITTED, options=STATED,
         expected="one value is off (the published a_00 is weaker than near lags ask)"),
    Case("the device's own values and noise, a_00 20 % deeper", OWN_ERRORS, near=MUCH_DEEPER,
         null=True, options=STATED, expected="one value is off: a_00 by -20e-8"),
    Case("errors x 0.19, the card held", OWN_ERRORS, options=(*STATED, "--no-device"),
         expected="lags of two pixels; no power of the charge"),
)  # fmt: skip


def table_of(case: Case, model: dict[tuple[int, int], float] | None = None) -> Table:
    """Table of a case: the measured one, changed."""
    table = Table.read(MEASURED, format="ascii.csv", comment="#")
    x, y = np.asarray(table["i_serial"]), np.asarray(table["j_parallel"])
    value, error = np.asarray(table["cov_per_e"]), np.asarray(table["err_per_e"])
    error = error * case.errors
    if model is not None:
        own = np.array([model.get((i, j), 0.0) for i, j in zip(x, y, strict=True)])
        value = own + error * np.random.default_rng(20191021).standard_normal(len(own))
    value = np.where((x == 0) & (y == 0), value * case.near, value)
    value = np.where(np.maximum(x, y) == 2, value * case.two, value)
    table["cov_per_e"], table["err_per_e"] = value, error
    return table


def device_values() -> dict[tuple[int, int], float]:
    """The a_ij [1/e-] of the baseline's table at its device's own conditions."""
    baseline = find_baseline(BASELINE)
    wavelength, back_bias = baseline.reference
    condition = Condition(wavelength=wavelength, back_bias=back_bias, temperature=None)
    a = baseline.areas_on(condition, None, baseline.level)
    y0, x0 = (n // 2 for n in a.shape)
    return {
        (i, j): float(a[y0 + j, x0 + i])
        for i in range(a.shape[1] - x0)
        for j in range(a.shape[0] - y0)
    }


def run_case(case: Case, folder: Path) -> dict[str, Any]:
    """Write a case's table, diagnose it by the command line, and summarise the report."""
    path = folder / "itl.csv"
    table_of(case, device_values() if case.null else None).write(
        path, format="ascii.csv", overwrite=True
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    out = folder / "out"
    subprocess.run(
        [
            sys.executable, "-m", "bfsensor", "diagnose", str(path),
            "--baseline", case.baseline, *case.options, "-o", str(out),
        ],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    report = json.loads((out / "report.json").read_text())
    return {
        "case": case.name, "baseline": case.baseline, "options": " ".join(case.options),
        "expected": case.expected, "detected": bool(report["detected"]),
        "p_value": float(report["p_value"]),
        "named": " ".join(e["class"] for e in report["effects"]),
        "said": " ".join(report["said"].split()) if isinstance(report["said"], str) else "",
        "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
    }  # fmt: skip


def main() -> None:
    """Diagnose all cases, print what is said, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    output = parser.parse_args().output
    rows = []
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            row = run_case(case, Path(folder))
        rows.append(row)
        print(f"{row['case']}: p = {row['p_value']:.2g}; {row['named'] or 'nothing named'}")
        print(f"  expected: {row['expected']}\n  {row['said']}\n", flush=True)
    write_results(Table(rows=rows), output, COMMAND)


if __name__ == "__main__":
    main()
