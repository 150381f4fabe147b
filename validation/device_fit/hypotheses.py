"""What the a_ij of 2019 and the seed paper's settings want: device, level, light, or readout.

``python -m validation.device_fit.hypotheses REFERENCE itl|e2v|seed`` fits the same numbers under each
hypothesis, all else alike, with the same errors (:data:`SCALES`; the seed paper's as stated):

- 'flat of 40,000 e-': its response, light converting at the back surface, the priors of the card;
- 'zero level': the limit at no charge, which a fit of covariances against level gives (not of the seed
  paper's covariances, which are of one level);
- 'red light': 950 nm;
- 'light of unknown length': 900 nm, with a factor on the absorption length that is fitted;
- 'doping by resistivity': the prior of :data:`~validation.device_fit.device_fit.RESISTIVITY`;
- 'readout': lags (1, 0) to (4, 0) are the readout's as well, by a free term each;
- 'all': zero level, doping by resistivity, readout.

Rows: of kind 'fit', value is the chi-square of the fitted lags, error that of the priors, pull twice the
logarithm of the evidence (Laplace's: chi-square and the volumes of posterior over prior; a readout's
term counts with a prior of 1e-8 per electron), count the number of lags; 'lag' and 'slope' are fitted
over measured, 'parameter' those of :data:`TOLD` in internal units.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from astropy.table import Table

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import ABSORPTION, choose_priors, with_priors
from bfsensor.fit.data import DataSet, apart_from_readout, data_set
from bfsensor.fit.finer_mesh import FINER
from bfsensor.fit.fit import fit_device
from bfsensor.fit.result import FitResult
from bfsensor.recording.tables.measured import read_measured
from validation.common.write_results import replace_run
from validation.device_fit.device_fit import (
    DEVICES,
    HELD,
    RESISTIVITY,
    SETTINGS,
    VOLTAGES,
    make_finer,
    seed_data,
)

RESULTS = Path(__file__).parents[1] / "results" / "device_hypotheses.ecsv"
COMMAND = "python -m validation.device_fit.hypotheses REFERENCE"

HYPOTHESES: dict[str, frozenset[str]] = {
    "flat of 40,000 e-": frozenset(),
    "zero level": frozenset({"level"}),
    "red light": frozenset({"light"}),
    "light of unknown length": frozenset({"length"}),
    "doping by resistivity": frozenset({"doping"}),
    "readout": frozenset({"readout"}),
    "all": frozenset({"level", "doping", "readout"}),
}

SCALES = {"itl": 0.1935, "e2v": 0.64465}
"""Scale of the stated errors.  Measured: by the scatter of the lags about the fits to the response of a
flat of 40,000 e-; about those to zero level it is 0.193 and 0.606, with which E2V's chi-squares would
be 13 % larger, all alike."""

READOUT_LAGS = 4
"""Lags along a row that have a term of the readout.  Chosen: all that are measured."""

READOUT_PRIOR = 1e-8
"""Standard deviation of a readout's term [1/e-].  Assumed: deferred charge of 5e-4 of the signal at
50,000 e- adds 1e-8; twice as large, each term costs 1.4 more in twice the logarithm of the evidence."""

LENGTHS = 0.5
"""Spread of that factor.  Chosen: at 900 nm it stands for light from 850 to 935 nm; with twice the
spread the factor reaches 0, where all light converts at the back, as without a wavelength."""

NEAREST = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
TOLD = (
    "silicon.background_doping", "operating_point.back_bias", "gates.gate_oxide",
    "channel_stop.width", "operating_point.hole_quasi_fermi_level", ABSORPTION,
)  # fmt: skip


def conditioned(data: DataSet, **changes: float) -> DataSet:
    """The data at another level or light."""
    return replace(data, conditions=tuple(replace(c, **changes) for c in data.conditions))


def data_of(reference: Path, which: str, asked: frozenset[str]) -> list[DataSet]:
    """Fitted data under a hypothesis, and the readout's lags, which are compared only."""
    if which == "seed":
        sets = [
            one for key in SETTINGS for one in seed_data(reference, key, np.ones((5, 5)))
        ]
        sets = [replace(one, scaled=False) for one in sets]
    else:
        one = data_set(read_measured(reference / f"{which}_covariances_21oct19.csv"))
        sets = [replace(one, errors=one.errors * SCALES[which], scaled=False)]
    changes: dict[str, float] = {}
    if "level" in asked and which != "seed":
        changes["level"] = 0.0
    if "light" in asked:
        changes["wavelength"] = 950.0
    if "length" in asked:
        changes["wavelength"] = 900.0
    sets = [conditioned(one, **changes) for one in sets]
    if "readout" not in asked:
        return sets
    return [
        part
        for one in sets
        for part in (
            apart_from_readout(one, READOUT_LAGS) if one.kind == "areas" else (one,)
        )
    ]


def evidence(result: FitResult, sets: list[DataSet]) -> tuple[float, float, float]:
    """Chi-square of the data and of the priors, and twice the logarithm of the evidence."""
    data = sum(
        one.chi2 for one, given in zip(result.sets, sets, strict=True) if given.fitted
    )
    prior = float(np.sum(((result.value - result.prior) / result.spread) ** 2))
    volume = float(
        np.linalg.slogdet(result.covariance / np.outer(result.spread, result.spread))[1]
    )
    # A term of the readout takes its lag's chi-square; its posterior is the lag's error.
    terms = sum(
        float(np.log(given.errors**2 / (given.errors**2 + READOUT_PRIOR**2)).sum())
        - float(
            ((one.after - given.values) ** 2 / (given.errors**2 + READOUT_PRIOR**2)).sum()
        )
        for one, given in zip(result.sets, sets, strict=True)
        if not given.fitted
    )
    return data, prior, volume - data - prior + terms


def fit_one(
    reference: Path, which: str, name: str, cells: int, finer: int, keep: Path
) -> tuple[list[dict[str, Any]], float]:
    """Rows of one hypothesis, and the CPU seconds that it took."""
    asked = HYPOTHESES[name]
    if which == "seed":
        device = Device.load("itl_sta3800c_60").with_operating_point(gate_high="4 V")
        voltages: tuple[str, ...] = ()
    else:
        device, voltages = Device.load(DEVICES[which]), VOLTAGES
    more = (*voltages, *((RESISTIVITY,) if "doping" in asked else ()))
    if "length" in asked:
        more = (*more, f"{ABSORPTION}:{LENGTHS}")
    priors = tuple(
        p
        for p in choose_priors(device, ("all", *more))
        if which != "e2v" or p.name not in HELD
    )
    device = with_priors(device, priors)
    sets = data_of(reference, which, asked)
    conditions = tuple(dict.fromkeys(c for one in sets for c in one.conditions))
    begin = time.process_time()
    result = fit_device(
        device, sets, priors, None, draws=0,
        linearise=make_finer(device, priors, conditions or (Condition(),), cells, finer, keep),
    )  # fmt: skip
    seconds = time.process_time() - begin
    chi2, prior, twice = evidence(result, sets)
    count = sum(len(one.values) for one in sets if one.fitted)
    base = {"hypothesis": name, "kind": "fit", "name": "", "i": -1, "j": -1}
    rows = [base | {"value": chi2, "error": prior, "pull": twice, "count": count}]
    for one, given in zip(result.sets, sets, strict=True):
        if one.kind != "areas":
            rows += [
                base | {"kind": "slope", "name": given.name, "i": int(i), "j": int(j), "count": 1,
                        "value": one.after[n] / given.values[n],
                        "error": given.errors[n] / given.values[n],
                        "pull": (one.after[n] - given.values[n]) / given.errors[n]}
                for n, (i, j) in enumerate(given.places)
            ]  # fmt: skip
            continue
        rows += [
            base | {"kind": "lag", "name": given.name, "i": int(i), "j": int(j), "count": 1,
                    "value": one.after[n] / given.values[n],
                    "error": given.errors[n] / abs(given.values[n]),
                    "pull": (one.after[n] - given.values[n]) / given.errors[n]}
            for n, (i, j) in enumerate(given.places.tolist()) if (i, j) in NEAREST
        ]  # fmt: skip
    for k, parameter in enumerate(result.parameters):
        if parameter in TOLD:
            rows.append(base | {"kind": "parameter", "name": parameter, "count": 1,
                                "value": float(result.value[k]), "error": float(result.error[k]),
                                "pull": float(result.pulls[k])})  # fmt: skip
    return rows, seconds


@click.command()
@click.argument("reference", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("which", type=click.Choice(["itl", "e2v", "seed"]))
@click.option(
    "--only", multiple=True, type=click.Choice(list(HYPOTHESES)), help="These alone."
)
@click.option(
    "--cells", default=16, show_default=True, help="Mesh cells a pixel of derivatives."
)
@click.option(
    "--finer", default=FINER, show_default=True, help="Mesh cells a pixel of a_ij."
)
@click.option("--keep", type=click.Path(path_type=Path), required=True,
              help="Folder of finished solutions.")  # fmt: skip
def main(
    reference: Path, which: str, only: tuple[str, ...], cells: int, finer: int, keep: Path
) -> None:
    """Fit the published numbers of WHICH under each hypothesis, and keep the rows."""
    for name in only or HYPOTHESES:
        if (which, name) == ("seed", "zero level"):
            continue
        rows, seconds = fit_one(reference, which, name, cells, finer, keep)
        run = f"{which}, {name}"
        replace_run(
            Table([{"run": run} | one for one in rows]), RESULTS, COMMAND, {"run": run},
            {"cpu_s": round(seconds, 1), "cells": cells, "finer": finer},
        )  # fmt: skip
        click.echo(f"{run}: " + "  ".join(
            f"{r['kind']} {r['name'][:12]} ({r['i']},{r['j']}) {r['value']:.3g} {r['pull']:+.1f}"
            for r in rows
        ))  # fmt: skip


if __name__ == "__main__":
    main()
