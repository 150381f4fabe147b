"""Mock a_ij of devices drawn from their priors, and what the fit returns of them.

``python -m validation.fit_recovery [DEVICE] [--errors FILE] [--mocks 50] [--truth emulator|solved]``
draws true parameters from the priors of a device, gives its a_ij errors like those of a measured
table (times ``--times``), fits them, and counts how often the truth lies within 1 and 1.96 posterior
errors.  ``solved``: true a_ij come from full solutions of each drawn device, so that the
emulator's own error counts: what it misses at ``CHECKED`` devices drawn from the priors is then told
to the fit as an error of its predictions; ``emulator``: from the emulator, so that it does not.
``--misstated 3`` tells the fit errors wrong by that factor, which the estimated scale has to find.
``--straight`` takes the tangent of the emulator at the priors for truth and fit: nothing bends.

Rows 'tangent': errors of a Gaussian of the tangent where the fit ends; 'posterior': those that the
fit states, of draws about its values; 'draws': central intervals of the draws, pulls being the
normal ones of the truth's rank among them (where nothing bends, those of 'posterior').  A row for
each parameter, for the combinations that the first mock measures best, for the best of each mock's
own ('own 1' to 'own 3') and for all parameters together replaces those of the same run in
``validation/results/fit_recovery.ecsv``, with Wilson bounds (95 %) of the coverage; the parameters
that are not told apart are in the header, with the number of mocks whose posterior was drawn from.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray
from scipy.stats import norm

from bfsensor import Device
from bfsensor.fit.data import DataSet, area_data
from bfsensor.fit.missed import Missed
from bfsensor.fit.posterior import find_posterior
from bfsensor.fit.predictors import Emulator, make_predictors
from bfsensor.fit.quantities import Prior, choose_priors, describe, with_priors
from bfsensor.fit.solve import ORDERED, Problem, solve
from bfsensor.fit.ties import find_ties, name_combination, principal
from bfsensor.recording.area_changes import read_area_changes
from bfsensor.recording.exposures import Condition
from validation.write_results import write_results

RESULTS = Path(__file__).parent / "results" / "fit_recovery.ecsv"
COMMAND = "python -m validation.fit_recovery"
LAGS = 4
VOLTAGES = ("back_bias:5 V", "gate_high:0.5 V", "gate_low:0.5 V")
"""Not stated with the data of 2019: parameters with priors."""

MEASURED = 0.7
"""Posterior over prior width below which a combination has a row of its own."""

OWN = 3
"""Best combinations of each mock's own that have rows."""

CHECKED = 12
"""Devices drawn from the priors at which what the emulator misses is measured."""

PREDICTED = ((0, 0), (1, 0), (0, 1), (1, 1))
"""Lags whose predicted a_ij are held against the true ones; (0, 0) was not fitted."""

Areas = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def draw_truth(priors: Sequence[Prior], rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw each parameter from its prior, anew where it lies outside its bounds.

    All of them anew where there is no such device, as with a gate oxide above the field oxide: half
    of the E2V device's neighbours.
    """
    names = [prior.name for prior in priors]
    out = np.empty(len(priors))
    while True:
        for n, prior in enumerate(priors):
            while True:
                out[n] = rng.normal(prior.mean, prior.spread)
                if prior.low < out[n] < prior.high:
                    break
        if not any(
            out[names.index(low)] > out[names.index(high)]
            for low, high in ORDERED
            if {low, high} <= set(names)
        ):
            return out


def recover(
    emulator: Emulator,
    priors: Sequence[Prior],
    errors: NDArray[np.float64],
    *,
    mocks: int,
    seed: int,
    areas: Areas | None = None,
    misstated: float = 1.0,
    emulator_misses: NDArray[np.float64] | None = None,
) -> tuple[list[dict[str, Any]], Mapping[str, Any]]:
    """Fit mocks of known devices.

    Parameters
    ----------
    emulator : Emulator
        What the fit uses.
    priors : sequence of Prior
        From which truths are drawn, and which the fit is told.
    errors : ndarray, shape (ny, nx)
        Of the mock a_ij [1/e-]; (0, 0) is left out.
    mocks : int
        How many.
    seed : int
        Of truths and noise.
    areas : callable, optional
        True a_ij of parameters [the emulator's]; raises ValueError where there is no such device,
        and another is drawn.
    misstated : float
        Errors told to the fit over true ones.
    emulator_misses : ndarray, shape (k, ny, nx), optional
        What the emulator misses of a_ij [1/e-] over the priors.

    Returns
    -------
    rows : list of dict
        ``pull`` and ``pull_rms`` of (fitted - true) / error with the error of the mean,
        ``within_68`` and ``within_95``, ``remains`` (posterior over prior error; of predictions
        relative to themselves), ``scale``.
    told : mapping
        Ties and silent parameters of the first mock, seconds a fit.
    """
    rng = np.random.default_rng(seed)
    names = tuple(prior.name for prior in priors)
    spreads = np.array([prior.spread for prior in priors])
    independent = np.ones(errors.shape, bool)
    independent[0, 0] = False
    ways = ("tangent", "posterior", "draws")
    pulls: dict[str, list[NDArray[np.float64]]] = {way: [] for way in ways}
    remains: dict[str, list[NDArray[np.float64]]] = {way: [] for way in ways}
    scales, chi2, told = [], [], {}
    directions = None
    seconds, drawn = 0.0, 0
    while len(scales) < mocks:
        truth = draw_truth(priors, rng)
        try:
            true = (
                np.asarray(emulator.predict(truth, Condition()).areas)
                if areas is None
                else areas(truth)
            )
        except ValueError:
            continue
        ny, nx = errors.shape
        noisy = true[:ny, :nx] + errors * rng.standard_normal(errors.shape)
        data = area_data("mock", noisy, misstated * errors, independent=independent)
        begin = time.process_time()
        problem = _problem(data, emulator, priors)
        tangent = solve(problem)
        missed = None
        if emulator_misses is not None:
            i, j = data.places.T
            missed = Missed(
                np.zeros((len(emulator_misses), len(priors))), (emulator_misses[:, j, i],)
            )
        posterior = find_posterior(problem, tangent, None, missed=missed)
        found, drawn = posterior.solution, drawn + ("draws" in posterior.record)
        seconds += time.process_time() - begin
        if directions is None:
            ties, silent = find_ties(names, tangent.sensitivity)
            told = {"ties": list(ties), "silent": [describe(n) for n in silent]}
            scaled = tangent.covariance / np.outer(spreads, spreads)
            directions = np.array(
                [one.weights for one in principal(scaled) if one.remains < MEASURED]
            )
            labels = [name_combination(names, weights) for weights in directions]
        off = (tangent.values - truth) / spreads
        for way, solution in zip(ways[:2], (tangent, found), strict=True):
            scaled = solution.covariance / np.outer(spreads, spreads)
            error = np.sqrt(np.diag(scaled))
            own = np.array([one.weights for one in principal(scaled)[:OWN]])
            # Combinations of parameters in units of their priors.
            along = np.concatenate([directions, own])
            width = np.sqrt(np.einsum("cp,pq,cq->c", along, scaled, along))
            pulls[way].append(np.concatenate([off / error, along @ off / width]))
            remains[way].append(np.concatenate([error, width]))
        if posterior.draws is None:
            pulls["draws"].append(pulls["posterior"][-1])
        else:
            ranks = np.vstack([np.eye(len(priors)), along])
            away = (posterior.draws - truth) / spreads @ ranks.T
            pulls["draws"].append(pulls_of_ranks(away))
        remains["draws"].append(remains["posterior"][-1])
        # What the fit predicts is as the tangent has it: held against the true ones there.
        told_areas, told_errors = _predicted(emulator, tangent.values, tangent.covariance)
        missed_areas = (
            told_areas - np.array([true[j, i] for i, j in PREDICTED])
        ) / told_errors
        pulls["tangent"][-1] = np.append(pulls["tangent"][-1], missed_areas)
        remains["tangent"][-1] = np.append(
            remains["tangent"][-1], np.abs(told_errors / told_areas)
        )
        scales.append(float(tangent.scales[0]))
        chi2.append(float(tangent.chi2[0]) / len(data.values))
    count, rows = len(priors), []
    kinds = ["parameter"] * count + ["combination"] * len(labels) + ["own"] * OWN
    called = [*map(describe, names), *labels, *(f"own {n + 1}" for n in range(OWN))]
    for way in ways:
        every, left = np.array(pulls[way]), np.array(remains[way])
        more = len(every[0]) - len(called)
        predicted = [f"a at {lag}" for lag in PREDICTED][:more]
        for n, (name, kind) in enumerate(
            zip([*called, *predicted], [*kinds, *["prediction"] * more], strict=True)
        ):
            rows.append({"way": way} | _row(name, kind, every[:, n]))
            rows[-1]["remains"] = round(float(np.mean(left[:, n])), 3)
        # Parameters of one mock share its noise: the mocks count, not the pulls.
        rows.append({"way": way} | _row("all parameters", "all", every[:, :count]))
        rows[-1]["remains"] = round(float(np.mean(left[:, :count])), 3)
    for row in rows:
        row |= {
            "mocks": mocks, "scale": round(float(np.mean(scales)), 3),
            "scale_scatter": round(float(np.std(scales)), 3),
            "chi2_per_n": round(float(np.mean(chi2)), 3),
        }  # fmt: skip
    return rows, told | {"cpu_s_a_fit": round(seconds / mocks, 3), "drawn": drawn}


def _predicted(
    emulator: Emulator, values: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Areas at the fitted values, and the errors that the posterior leaves them."""
    response = emulator.predict(values, Condition())
    i, j = np.array(PREDICTED).T
    slope = np.asarray(response.jacobian)[:, j, i]
    errors = np.sqrt(np.einsum("pn,pq,qn->n", slope, covariance, slope))
    return np.asarray(response.areas)[j, i], errors


def _problem(data: DataSet, emulator: Emulator, priors: Sequence[Prior]) -> Problem:
    return Problem(tuple(priors), (data,), make_predictors((data,), emulator, priors))


def _row(name: str, kind: str, pulls: NDArray[np.float64]) -> dict[str, Any]:
    """Bias and coverage with their errors from the scatter between mocks."""
    by_mock = pulls.reshape(len(pulls), -1)

    def mean(values: NDArray[np.float64]) -> tuple[float, float]:
        each = values.mean(1)
        return round(float(each.mean()), 3), round(
            float(each.std(ddof=1) / np.sqrt(len(each))), 3
        )

    bias, one, two = (
        mean(v) for v in (by_mock, np.abs(by_mock) <= 1, np.abs(by_mock) <= 1.96)
    )
    return {
        "name": name, "kind": kind, "pull": bias[0], "pull_error": bias[1],
        "pull_rms": round(float(np.sqrt(np.mean(by_mock**2))), 3),
        "within_68": one[0], "within_68_error": one[1],
        "within_95": two[0], "within_95_error": two[1],
    } | {
        f"within_{share}_{end}": bound
        for share, part in (("68", one[0]), ("95", two[0]))
        for end, bound in zip(("low", "high"), wilson(part, len(by_mock)), strict=True)
    }  # fmt: skip


def pulls_of_ranks(away: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pulls of the truth as many draws as lie above it would have of a normal distribution.

    Parameters
    ----------
    away : ndarray, shape (m, k)
        Draws less the truth.
    """
    above = (np.sum(away > 0, axis=0) + 0.5) / (len(away) + 1)
    return np.asarray(norm.ppf(above))


def wilson(part: float, count: int, z: float = 1.96) -> tuple[float, float]:
    """Bounds of a share that was counted among independent trials (Wilson 1927)."""
    middle = (part + z**2 / (2 * count)) / (1 + z**2 / count)
    half = (
        z / (1 + z**2 / count) * np.sqrt(part * (1 - part) / count + (z / (2 * count)) ** 2)
    )
    return round(float(middle - half), 3), round(float(middle + half), 3)


def measure_misses(
    emulator: Emulator, priors: Sequence[Prior], areas: Areas, seed: int
) -> NDArray[np.float64]:
    """What an emulator misses of a_ij [1/e-] at devices drawn from the priors, (k, ny, nx)."""
    rng, out = np.random.default_rng(seed), []
    while len(out) < CHECKED:
        values = draw_truth(priors, rng)
        try:
            solved = areas(values)
        except ValueError:
            continue
        found = np.asarray(emulator.predict(values, Condition()).areas)
        out.append(solved[: len(found), : len(found)] - found)
    return np.array(out)


def main() -> None:
    """Recover mocks, print and append the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("device", nargs="?", default="itl_sta3800c_60")
    parser.add_argument("--errors", type=Path, required=True,
                        help="table of a_ij whose errors the mocks have")  # fmt: skip
    parser.add_argument("--times", type=float, default=1.0, help="of those errors")
    parser.add_argument("--misstated", type=float, default=1.0)
    parser.add_argument("--mocks", type=int, default=50)
    parser.add_argument("--truth", choices=("emulator", "solved"), default="emulator")
    parser.add_argument("--straight", action="store_true")
    parser.add_argument(
        "--held", nargs="*", default=[], help="names that are not free after all"
    )
    parser.add_argument("--free", nargs="+", default=["all", *VOLTAGES])
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--seed", type=int, default=7301)
    parser.add_argument("--keep", type=Path, help="folder of the emulator's solves")
    parser.add_argument("--emulator", type=Path, help="file of one, in place of solves")
    options = parser.parse_args()
    from bfsensor.fit.emulator import DeviceEmulator
    from bfsensor.fit.linearised import LinearEmulator, LinearResponse

    device = Device.load(options.device)
    priors = tuple(
        p for p in choose_priors(device, tuple(options.free)) if p.name not in options.held
    )
    device = with_priors(device, priors)
    begin = time.process_time()
    emulator: Emulator
    if options.emulator is not None:
        emulator = DeviceEmulator.read(options.emulator, device=device)
    else:
        emulator = DeviceEmulator.build(
            device, [prior.name for prior in priors], conditions=(Condition(),),
            cells=options.cells, keep=options.keep,
        )  # fmt: skip
    built = time.process_time() - begin
    errors = (
        options.times * read_area_changes(options.errors).errors[: LAGS + 1, : LAGS + 1]
    )
    areas = (
        None if options.truth == "emulator" else solved_areas(device, priors, options.cells)
    )
    begin = time.process_time()
    misses = (
        None if areas is None else measure_misses(emulator, priors, areas, options.seed + 1)
    )
    if options.straight:
        means = np.array([prior.mean for prior in priors])
        at = emulator.predict(means, Condition())
        here = LinearResponse(at.kx, at.ky, at.dkx, at.dky)
        emulator = LinearEmulator(emulator.parameters, means, {Condition(): here})
    rows, told = recover(
        emulator, priors, errors, mocks=options.mocks, seed=options.seed, areas=areas,
        misstated=options.misstated, emulator_misses=misses,
    )  # fmt: skip
    run = {
        "device": options.device, "errors": options.errors.stem, "times": options.times,
        "misstated": options.misstated, "free": " ".join(options.free),
        "truth": "straight" if options.straight else options.truth,
        "cells": options.cells, "seed": options.seed,
    }  # fmt: skip
    cost = {
        "cpu_s_build": round(built, 1),
        "cpu_s_mocks": round(time.process_time() - begin, 1),
    }
    table = Table([run | row | cost for row in rows])
    print("\n".join(table[[*rows[0]]].pformat(max_lines=-1, max_width=-1)))
    for word, text in (told | cost).items():
        print(f"{word}: {text}")
    append(table, run, told)


def solved_areas(device: Device, priors: Sequence[Prior], cells: int) -> Areas:
    """a_ij of full solutions of a device with other parameters, on its mesh moved with it."""
    from bfsensor.fit.changing import device_at
    from bfsensor.response import area_matrix, solve_response

    def areas(values: NDArray[np.float64]) -> NDArray[np.float64]:
        there = device_at(device, Condition(), priors, values)
        found = solve_response(there, cells=cells, laid_for=device)
        a = area_matrix(*found.edges(None, there.operating_point.temperature))
        return np.asarray(a[len(a) // 2 :, len(a) // 2 :])

    return areas


def append(table: Table, run: Mapping[str, Any], told: Mapping[str, Any]) -> None:
    """Replace the rows of the same run, and what its header says."""
    key = " ".join(f"{value}" for value in run.values())
    meta: dict[str, Any] = {}
    if RESULTS.exists():
        old = Table.read(RESULTS, format="ascii.ecsv")
        meta = {k: v for k, v in old.meta.items() if k not in ("command", "commit")}
        other = np.zeros(len(old), bool)
        for name, value in run.items():
            other |= np.asarray(old[name] != value)
        table = vstack([old[other], table], metadata_conflicts="silent")
    write_results(table, str(RESULTS), COMMAND, **(meta | {key: dict(told)}))


if __name__ == "__main__":
    main()
