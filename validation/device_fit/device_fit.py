"""Devices of LSST's two vendors fitted to what was published of them.

``python -m validation.device_fit.device_fit REFERENCE areas itl|e2v`` fits the a_ij of October 2019
(``REFERENCE/{itl,e2v}_covariances_21oct19.csv``, Poisson_CCD repository @ 876adb8), 24 lags without
(0, 0), which the sum rule had set, as the limit at no charge (``--level``).  Voltages are not stated
with them; the simulation that was published beside them had those of ``itl_sta3800c_60`` and
``e2v_ccd250_70``, whose chi2 before any fit is 0.4 and 0.03 of that at the settings of GalSim's
tables.  Back bias (5 V) and gates (0.5 V) are free with priors.

``seed`` fits one ITL device to the covariances and B-F slopes at -60 V, +4/-8 V of the seed paper
(Lage, Bradshaw and Tyson 2017, figure 9; voltages stated and held) and predicts what it was not
fitted to: -30 V, +6/-6 V.  ``--slope`` takes the covariances over the level squared as a_ij, as the
paper does; otherwise as those of a flat of 80,000 e-, which by higher orders of the a_ij are less.
``--every`` fits all three settings: whether any device within the priors shows them.

Wherever a device is solved, fitted or predicted, a_ij and slopes are those of ``--finer`` cells a
pixel, derivatives those of ``--cells``.

``--resistivity`` takes the prior of the doping from what the wafers were specified to be
(``RESISTIVITY``), not from the value of the published simulation.  ``doping FIT...`` gives what
other priors of the doping would make of finished fits, by the tangent where each ended.

``wells`` predicts saturation levels with the device that ``seed`` has fitted.

Rows of a run replace those of the same run in ``validation/results/device_fit.ecsv``; fit.json
and device.toml go to ``--keep``.  Kinds of rows: 'areas' [1/e-], 'slopes' [% for 50,000 e-], 'wells'
[e-]; 'parameter': measured and error are the prior's, in units of device files;
'chi2' over the number of values (measured), errors as stated; 'scale' of the errors;
'combination': after is posterior over prior width; 'doping' [1e12 cm-3]: measured and error are
the prior's.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from astropy.io import ascii as text_tables
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import (
    Prior,
    choose_priors,
    describe,
    quantities,
    with_priors,
)
from bfsensor.fit.data import DataSet, area_data, data_set, select
from bfsensor.fit.degeneracies import name_combination
from bfsensor.fit.finer_mesh import FINER, Finer
from bfsensor.fit.fit import fit_device
from bfsensor.fit.linear_response import Linearise
from bfsensor.fit.prediction_error import DRAWS
from bfsensor.fit.predictors import make_predictors
from bfsensor.fit.result import FitResult
from bfsensor.measure.toy_array import close_sum, predict_array
from bfsensor.recording.tables.measured import read_measured
from bfsensor.response.edge_response import area_matrix
from bfsensor.simulate.well import full_well
from validation.common.run_header import commit_here
from validation.common.write_results import replace_run

RESULTS = Path(__file__).parents[1] / "results" / "device_fit.ecsv"
COMMAND = "python -m validation.device_fit.device_fit REFERENCE"
VOLTAGES = ("back_bias:5 V", "gate_high:0.5 V", "gate_low:0.5 V")
DEVICES = {"itl": "itl_sta3800c_60", "e2v": "e2v_ccd250_70"}
FITTED = {"itl": "itl_sta3800c_2019", "e2v": "e2v_ccd250_2019"}
GALSIM = {"itl": "lsst_itl_50_32", "e2v": "lsst_e2v_50_32"}
HELD = ("gates.gate_oxide", "gates.field_oxide")
"""In the E2V device: its oxides are equally thick, and a field oxide cannot be the thinner one, so
that the fit begins at a kink and at the end of what can be for both."""

RESISTIVITY = "background_doping:-1.7e12 cm-3 +- 0.7e12 cm-3"
"""Of LSST's sensors: above 5 kOhm cm (Radeka, Sensor Development Program, LSST directors' review,
SLAC, March 2006), at 470 cm2/V/s fewer than 2.7e12 acceptors a cm3; high-resistivity wafers of
CCDs reach 10 to 12 kOhm cm (LBNL's, n-type; notes of E. Hoeg, SAG_CUO_57, 1999) and are sold above.
20 kOhm cm, taken as the end, are 0.66e12: mean and standard deviation of an even distribution
between the two, 1.68 +- 0.59, and somewhat wider.
Published simulations of the ITL device have 1.0e12 (Poisson_CCD22 of 2015, data/run1/bf.cfg at -60 V,
+4/-8 V) and 2.4e12 (its successors of 2017 and 2019); neither says from what measurement."""

DOPING = "silicon.background_doping"

SEED_LEVEL = 80_000.0
SETTINGS = {"A": (-60.0, 4.0, -8.0), "B": (-30.0, 4.0, -8.0), "C": (-60.0, 6.0, -6.0)}
WELLS = (
    (-8.0, 0.0), (-8.0, 1.0), (-8.0, 2.0), (-8.0, 3.0), (-6.0, 2.0), (-6.0, 4.0), (-4.0, 3.0),
)  # fmt: skip
"""Low and high gates whose measured saturation is predicted."""

WAVELENGTH = 621.0
"""Of the spots [nm]; that of the flats is not stated, and taken the same."""

COLUMNS = (
    "measured", "error", "before", "after", "after_error", "pull", "published", "galsim",
)  # fmt: skip
Lags = Mapping[tuple[int, int], float]


def row(kind: str, name: str, i: int = -1, j: int = -1, **numbers: float) -> dict[str, Any]:
    """One row; numbers that it has not are nan."""
    known = {column: float(numbers.get(column, np.nan)) for column in COLUMNS}
    return {"kind": kind, "name": name, "i": i, "j": j} | known


def published_areas(reference: Path, vendor: str) -> tuple[Lags, Lags]:
    """a_ij of the published run and of GalSim's table [1/e-], by lag (i, j)."""
    run = text_tables.read(
        reference / f"poisson_ccd_repo_pixel-{vendor}_sim_area_cov.csv", comment="#"
    )
    galsim = text_tables.read(reference / "galsim_effective_areas.csv", comment="#")
    galsim = galsim[(galsim["table"] == GALSIM[vendor]) & (galsim["qdist"] == 4)]
    return (
        {(int(r[0]), int(r[1])): float(r[2]) for r in run},
        {(int(r["xlag"]), int(r["ylag"])): float(r["dA_over_A_per_e"]) for r in galsim},
    )


def rows_of(
    result: FitResult, published: Mapping[str, Lags] = {}, galsim: Mapping[str, Lags] = {}
) -> list[dict[str, Any]]:
    """Rows of a fit: data, parameters, combinations, chi2 and scale of each set."""
    rows = []
    for one in result.sets:
        theirs = [published.get(one.name, {}), galsim.get(one.name, {})]
        beside = np.array(
            [[t.get((int(i), int(j)), np.nan) for t in theirs] for i, j in one.places]
        )
        for n, (i, j) in enumerate(one.places.tolist()):
            rows.append(row(
                one.kind, one.name, i, j, measured=one.values[n], error=one.errors[n],
                before=one.before[n], after=one.after[n], after_error=one.after_error[n],
                pull=one.pulls[n], published=beside[n, 0], galsim=beside[n, 1],
            ))  # fmt: skip
        chi2 = np.mean(((beside - one.values[:, None]) / one.errors[:, None]) ** 2, axis=0)
        count = len(one.values)
        rows.append(row(
            "chi2", one.name, measured=count, before=one.chi2_before / count,
            after=one.chi2 / count, published=chi2[0], galsim=chi2[1],
        ))  # fmt: skip
        rows.append(row("scale", one.name, after=one.scale, after_error=one.scale_error))
    known = quantities(Device.from_toml(result.device))
    for k, name in enumerate(result.parameters):
        unit = known[name]
        rows.append(row(
            "parameter", f"{describe(name)} [{unit.unit}]", measured=unit.number(result.prior[k]),
            error=unit.number(result.spread[k]), before=unit.number(result.prior[k]),
            after=unit.number(result.value[k]), after_error=unit.number(result.error[k]),
            pull=result.pulls[k],
        ))  # fmt: skip
    rows += [
        row("combination", name_combination(result.parameters, weights), after=part)
        for part, weights in zip(result.remains[:6], result.weights[:6], strict=True)
    ]
    return rows


def append(run: str, rows: Sequence[Mapping[str, Any]], **told: Any) -> None:
    """Replace the rows of a run, and what the header says of it."""
    table = Table([{"run": run} | dict(one) for one in rows])
    replace_run(table, RESULTS, COMMAND, {"run": run}, told)


@click.group()
@click.argument("reference", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.pass_context
def main(ctx: click.Context, reference: Path) -> None:
    """Fit devices to the published measurements in REFERENCE, and append the rows."""
    ctx.obj = reference


_CELLS = click.option("--cells", default=16, show_default=True, help="Mesh cells a pixel.")
_FINER = click.option("--finer", default=FINER, show_default=True,
                      help="Cells a pixel of a_ij and slopes.")  # fmt: skip
_RESISTIVITY = click.option("--resistivity", is_flag=True,
                            help="Prior of the doping by the wafers' specification.")  # fmt: skip
_DRAWS = click.option("--draws", default=DRAWS, show_default=True,
                      help="Devices drawn from the posterior that are solved.")  # fmt: skip
_KEEP = click.option("--keep", type=click.Path(path_type=Path), required=True,
                     help="Folder of fit.json and device.toml.")  # fmt: skip


@main.command()
@click.argument("vendor", type=click.Choice(list(DEVICES)))
@_CELLS
@_FINER
@_DRAWS
@_RESISTIVITY
@_KEEP
@click.option("--level", default=0.0, show_default=True,
              help="Level [e-] of the flats that responded; 0: the limit at no charge.")  # fmt: skip
@click.pass_obj
def areas(
    reference: Path,
    vendor: str,
    cells: int,
    finer: int,
    draws: int,
    resistivity: bool,
    keep: Path,
    level: float,
) -> None:
    """Fit the a_ij of 2019."""
    device = Device.load(DEVICES[vendor])
    out = HELD if vendor == "e2v" else ()
    priors = tuple(
        p
        for p in choose_priors(device, ("all", *VOLTAGES, *_doping(resistivity)))
        if p.name not in out
    )
    device = with_priors(device, priors)
    data = data_set(read_measured(reference / f"{vendor}_covariances_21oct19.csv"))
    data = replace(data, conditions=tuple(replace(c, level=level) for c in data.conditions))
    at = (Condition(level=level),)
    begin = time.process_time()
    solve = make_finer(device, priors, at, cells, finer, keep)
    result = fit_device(
        device, [data], priors, None, draws=draws, linearise=solve, solved=solve.at_draw,
        source=f"bfsensor fit of {data.name}, 24 lags; errors are correlated: fit.json",
    )  # fmt: skip
    seconds = time.process_time() - begin
    _write(result, keep, FITTED[vendor])
    run, galsim = published_areas(reference, vendor)
    rows = rows_of(result, {data.name: run}, {data.name: galsim})
    append(vendor + " by resistivity" * resistivity, rows, **_told(result, seconds))
    click.echo(result.said())


def _doping(resistivity: bool) -> tuple[str, ...]:
    """Give what is asked of the doping besides."""
    return (RESISTIVITY,) if resistivity else ()


def kept_solutions(keep: Path) -> Path:
    """Where finished solutions are: the version alone does not tell those of two commits apart."""
    return keep / f"finer_{commit_here()}"


def make_finer(
    device: Device,
    priors: tuple[Prior, ...],
    at: tuple[Condition, ...],
    cells: int,
    finer: int,
    keep: Path,
) -> Finer:
    """What solves a device at conditions, on both meshes."""
    solve = Linearise(device, priors, at, cells)
    return Finer(solve, device, priors, at, finer, cells, keep=kept_solutions(keep))


@main.command()
@_CELLS
@_FINER
@_DRAWS
@_RESISTIVITY
@_KEEP
@click.option("--slope", is_flag=True, help="Covariance over the level squared is a_ij.")
@click.option("--every", is_flag=True, help="Fit all settings, predict none.")
@click.pass_obj
def seed(
    reference: Path,
    cells: int,
    finer: int,
    draws: int,
    resistivity: bool,
    keep: Path,
    slope: bool,
    every: bool,
) -> None:
    """Fit one ITL device at -60 V, +4/-8 V, and predict the other settings."""
    device = Device.load("itl_sta3800c_60").with_operating_point(gate_high="4 V")
    priors = choose_priors(device, ("all", *_doping(resistivity)))
    at = {key: condition_at(key) for key in SETTINGS}
    begin = time.process_time()
    sets, unfitted, less = {}, {}, {}
    for key in SETTINGS:
        unfitted[key] = make_finer(device, (), (at[key],), cells, finer, keep)(np.empty(0))
        response = unfitted[key].predict(np.empty(0), at[key])
        a = area_matrix(response.kx, response.ky)[1:-1, 1:-1]
        less[key] = np.ones((5, 5)) if slope else lost_to_higher_orders(a, SEED_LEVEL)
        sets[key] = seed_data(reference, key, less[key])
    fitted = tuple(SETTINGS) if every else ("A",)
    conditions = tuple(at[key] for key in fitted)
    solve = make_finer(device, priors, conditions, cells, finer, keep)
    result = fit_device(
        device, [one for key in fitted for one in sets[key]], priors, None,
        linearise=solve, solved=solve.at_draw, draws=draws,
        source="bfsensor fit of figure 9 of Lage, Bradshaw and Tyson (2017)",
    )  # fmt: skip
    run = "seed" + " as slopes" * slope + " every" * every
    run += " by resistivity" * resistivity
    _write(result, keep, run.replace(" ", "_"))
    published = {
        one.name: seed_published(reference, one) for s in sets.values() for one in s
    }
    rows = rows_of(result, published)
    for key in SETTINGS:
        if key in fitted:
            continue
        after = make_finer(device, priors, (at[key],), cells, finer, keep)(result.value)
        for data in sets[key]:
            rows += predicted_rows(
                data, unfitted[key], after, priors, result, published[data.name]
            )
    seconds = time.process_time() - begin
    lost = {
        key: [round(float(one[j, i]), 4) for i, j in ((1, 0), (0, 1))]
        for key, one in less.items()
    }
    append(run, rows, **_told(result, seconds), less_at_10_and_01=lost)
    click.echo(result.said())


def lost_to_higher_orders(a: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Covariance over the level squared relative to a_ij, by lag [j, i] to 4."""
    closed = close_sum(0.5 * (a + a[::-1, ::-1]))
    covariance = predict_array(closed, level)[:5, :5]
    middle = len(a) // 2
    quadrant = a[middle : middle + 5, middle : middle + 5]
    out = np.ones((5, 5))
    known = np.zeros((5, 5), bool)
    # Where a_ij is large: farther out the orders are below the errors, and the ratio is of noise.
    known[:3, :3] = True
    known[0, 0] = False
    out[known] = (covariance / level**2)[known] / quadrant[known]
    return out


def condition_at(key: str) -> Condition:
    """Light and voltages of a setting."""
    back, high, low = SETTINGS[key]
    return Condition(wavelength=WAVELENGTH, back_bias=back, gate_high=high, gate_low=low)


def seed_data(reference: Path, key: str, less: NDArray[np.float64]) -> list[DataSet]:
    """Covariances, over level squared and what higher orders take, and slopes at a setting."""
    at = condition_at(key)
    table = text_tables.read(reference / "seed_fig9_covariance_80ke.csv", comment="#")
    table = table[table["condition"] == key]
    a, errors = np.full((2, 5, 5), np.nan)
    for one in table:
        j, i = int(one["ylag"]), int(one["xlag"])
        # Half the upper error bar is there where the lower one was clipped.
        for into, column in ((a, "meas_cov"), (errors, "meas_err_upper_over_2")):
            into[j, i] = float(np.ma.filled(one[column], np.nan)) / SEED_LEVEL / less[j, i]
    measured = read_measured(reference / "bf_slopes.csv").at(
        {"wavelength": f"{WAVELENGTH} nm"}
    )
    every = data_set(measured, name=f"slopes {key}")
    mine = [n for n, c in enumerate(every.conditions) if c == at][:2]
    slopes = select(every, np.isin(np.arange(len(every.values)), mine), f"slopes {key}")
    return [area_data(f"areas {key}", a, errors, condition=at), slopes]


def seed_published(reference: Path, data: DataSet) -> Lags:
    """What the paper simulated, by lag, or by axis of slopes as (0, 0) and (1, 0)."""
    key = data.name[-1]
    if data.kind == "slopes":
        table = text_tables.read(reference / "bf_slopes.csv", comment="#")
        back, high, _ = SETTINGS[key]
        return {
            (int(r["axis"] == "y"), 0): float(r["sim_pct_per_50ke"]) for r in table
            if r["provenance"] == "P" and r["Vbb_V"] == back and r["Vpar_hi_V"] == high
        }  # fmt: skip
    table = text_tables.read(reference / "seed_fig9_covariance_80ke.csv", comment="#")
    return {
        (int(r["xlag"]), int(r["ylag"])): float(r["sim_dA_over_A"]) / SEED_LEVEL
        for r in table if r["condition"] == key
    }  # fmt: skip


def predicted_rows(
    data: DataSet, before: Any, after: Any, priors: Any, result: FitResult, published: Lags
) -> list[dict[str, Any]]:
    """Rows of a data set that was not fitted; pulls with the prediction's error besides."""
    first, _ = make_predictors([data], before, priors)[0](result.prior)
    then, slope = make_predictors([data], after, priors)[0](result.value)
    open_ = np.sqrt(np.einsum("np,pq,nq->n", slope, result.covariance, slope))
    rows = [
        row(data.kind, data.name, int(i), int(j), measured=data.values[n], error=data.errors[n],
            before=first[n], after=then[n], after_error=open_[n],
            pull=(then[n] - data.values[n]) / np.hypot(data.errors[n], open_[n]),
            published=published.get((int(i), int(j)), np.nan))
        for n, (i, j) in enumerate(data.places)
    ]  # fmt: skip
    theirs = np.array([one["published"] for one in rows])
    chi2 = [
        float(np.mean(((v - data.values) / data.errors) ** 2))
        for v in (first, then, theirs)
    ]
    return [*rows, row("chi2", data.name, measured=len(rows), before=chi2[0], after=chi2[1],
                       published=chi2[2])]  # fmt: skip


@main.command()
@click.argument("fits", nargs=-1, required=True, type=click.Path(path_type=Path))
def doping(fits: tuple[Path, ...]) -> None:
    """Give finished fits other priors of the doping: as fitted, by resistivity, wider, none."""
    rows = []
    for path in fits:
        result = FitResult.read(path)
        k = result.parameters.index(DOPING)
        own = float(result.prior[k]), float(result.spread[k])
        (asked,) = choose_priors(Device.from_toml(result.device), (RESISTIVITY,))
        for mean, spread in (own, (asked.mean, asked.spread), (own[0], 1.0), (own[0], 1e3)):
            value, error = with_prior(result, k, mean, spread)
            rows.append(row(
                "doping", path.parent.name, measured=mean, error=spread, before=result.value[k],
                after=value, after_error=error, pull=(value - mean) / spread,
            ))  # fmt: skip
            click.echo(rows[-1])
    append("doping", rows)


def with_prior(
    result: FitResult, k: int, mean: float, spread: float
) -> tuple[float, float]:
    """Give one parameter and its error with another prior of its own, by the tangent."""
    precision = np.linalg.inv(result.covariance)
    pulled = precision @ result.value
    precision[k, k] += 1 / spread**2 - 1 / result.spread[k] ** 2
    pulled[k] += mean / spread**2 - result.prior[k] / result.spread[k] ** 2
    covariance = np.linalg.inv(precision)
    return float((covariance @ pulled)[k]), float(np.sqrt(covariance[k, k]))


@main.command()
@_KEEP
@click.option("--cells", default=8, show_default=True, help="Mesh cells a pixel.")
@click.pass_obj
def wells(reference: Path, keep: Path, cells: int) -> None:
    """Predict saturation levels with the device of the seed fit, and without the fit."""
    result = FitResult.read(keep / "fit.json")
    table = text_tables.read(reference / "sat_data_21oct19.csv", comment="#")
    devices = [Device.from_toml(text) for text in (result.device, result.fitted_device)]
    rows = []
    begin = time.process_time()
    for low, high in WELLS:
        (at,) = np.flatnonzero((table["Vpar_lo_V"] == low) & (table["Vpar_hi_V"] == high))
        levels = [
            full_well(
                device.with_operating_point(gate_low=f"{low} V", gate_high=f"{high} V"),
                cells=cells,
            )
            for device in devices
        ]
        rows.append(row(
            "wells", f"{low:g}/{high:g} V", measured=float(table["sat_level_e"][at]),
            before=levels[0], after=levels[1],
        ))  # fmt: skip
        click.echo(rows[-1])
    append("wells", rows, cells=cells, cpu_s=round(time.process_time() - begin, 1))


def _write(result: FitResult, keep: Path, name: str) -> None:
    keep.mkdir(parents=True, exist_ok=True)
    result.write(keep / "fit.json")
    replace(Device.from_toml(result.fitted_device), name=name).write(keep / "device.toml")


def _told(result: FitResult, seconds: float) -> dict[str, Any]:
    mesh = result.mesh
    one = mesh["ratios"][0]
    ratios = {
        f"({i},{j})": [round(one[k][j][i], 4) for k in ("finer_over_own", "at_the_priors")]
        for i, j in ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
    }
    return {
        "cells": mesh["cells"], "finer": mesh["finer"], "finer_over_own": ratios,
        "cpu_s": round(seconds, 1), "notes": list(result.notes),
        "posterior": {k: v for k, v in result.posterior.items() if k in ("curved", "solved")},
        "ties": list(result.ties), "silent": list(result.silent),
    }  # fmt: skip


if __name__ == "__main__":
    main()
