"""Spots with known truth: what the fit, the moments and the slopes give back.

``python -m validation.measurement_errors.spot_mocks [--mocks 200] [--spots 300] [-o OUT.ecsv]``
makes regions of spots at random centres with Poisson and read noise, measures each and compares
with the truth in units of the stated errors.  Cases:

- ``size``: one shape, several peaks; the forward model, and adaptive moments, whose truth are
  those of the same spots without noise (they know no pixel).
- ``slope``: ladders of twelve peaks whose widths grow linearly; ``slope_bend``: the same with
  a sharp growth from 200,000 e- on, as measured spots have it.
- ``moffat``: spots with the wings of a Moffat profile and no growth.  The fit is of the wrong
  profile, and chi2 tells.  Weighted by noise its width moves with the peak, because the weights
  do: ``moffat_slope`` is the slope that this feigns, in units of 50,000 e- and per cent.

Methods: ``noise`` and ``equal`` are the weights of the forward model.

Columns: pulls are (found - truth) / error; ``within_1`` and ``within_2`` the fraction of them
below 1 and 2; ``found`` for moffat only; of slopes ``peak`` is the median end of the range found.
``spots_per_s`` is by process time, one thread.  The pull of every mock of sizes and slopes is in
``results/spot_pulls.ecsv``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.measure.slopes import bf_slopes
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spot_model import Shape, integrate_gaussian
from bfsensor.measure.spot_moments import measure_moments
from bfsensor.measure.spot_result import SpotFit
from bfsensor.measure.spots import Stamps
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "spot_mocks.ecsv"
PULLS = "spot_pulls.ecsv"
COMMAND = "python -m validation.measurement_errors.spot_mocks"
SHAPE = Shape(1.02, 1.05)
READ_NOISE = 5.0
# Measured at -60 V by Lage et al. (2017), Fig. 9 [% per 50,000 e-].
SLOPES = (0.71, 0.94)
LADDER = np.linspace(20e3, 240e3, 12)
BEND = 200e3
SIZES = ((500.0, 10.0), (2e3, 100.0), (20e3, 100.0), (100e3, 100.0))  # peak, background
SIZE_SEED, SLOPE_SEED, BEND_SEED, WINGS_SEED = 310, 320, 321, 330


def gaussian(x: NDArray, y: NDArray, shape: Shape) -> NDArray:
    """Fractions in 9 x 9 pixels."""
    return integrate_gaussian(x, y, shape, 9)


def moffat(x: NDArray, y: NDArray, shape: Shape, *, beta: float = 4.0) -> NDArray:
    """Fractions in 9 x 9 pixels of a Moffat profile with a Gaussian's height and flux.

    Integrated by 6 x 6 points of Gauss and Legendre in each pixel.
    """
    nodes, weights = np.polynomial.legendre.leggauss(6)
    places = ((np.arange(9) - 4)[:, None] + 0.5 * nodes).ravel()
    u = (places - x[:, None]) / shape.sigma_x
    v = (places - y[:, None]) / shape.sigma_y
    # (beta - 1) / (pi a^2) = 1 / (2 pi)
    radius = 2 * (beta - 1)
    profile = (1 + (u[:, None, :] ** 2 + v[:, :, None] ** 2) / radius) ** -beta
    profile /= 2 * np.pi * shape.sigma_x * shape.sigma_y
    cells = profile.reshape(len(x), 9, 6, 9, 6)
    return np.einsum("njaib,a,b->nji", cells, 0.5 * weights, 0.5 * weights)


def make_spots(
    rng: np.random.Generator,
    spots: int,
    peak: float,
    widths: Shape | Callable[[float], Shape],
    *,
    background: float = 100.0,
    read_noise: float = READ_NOISE,
    profile: Callable[..., NDArray] = gaussian,
) -> tuple[Stamps, Stamps]:
    """Stamps with noise and without; peaks scatter by 5 % about the one given.

    The shape may depend on the region's mean peak, as it is and not as it was asked for.
    """
    x, y = rng.uniform(-0.5, 0.5, (2, spots))
    each = peak * rng.uniform(0.95, 1.05, spots)
    shape = widths if isinstance(widths, Shape) else widths(float(each.mean()))
    each /= profile(np.zeros(1), np.zeros(1), shape)[0, 4, 4]
    mean = each[:, None, None] * profile(x, y, shape) + background
    noisy = rng.poisson(mean) + rng.normal(0.0, read_noise, mean.shape)
    return Stamps(noisy), Stamps(mean)


def summarise(pulls: NDArray) -> dict[str, float]:
    """Mean, scatter and coverage of pulls (mocks, 2)."""
    row = {}
    for k, axis in enumerate("xy"):
        row[f"mean_pull_{axis}"] = pulls[:, k].mean()
        row[f"rms_pull_{axis}"] = pulls[:, k].std(ddof=1)
        row[f"within_1_{axis}"] = np.mean(np.abs(pulls[:, k]) < 1)
        row[f"within_2_{axis}"] = np.mean(np.abs(pulls[:, k]) < 2)
    return row


def list_pulls(
    case: str, method: str, peak: float, pulls: NDArray
) -> list[dict[str, object]]:
    """Rows of the pulls (mocks, 2) of one case, mock by mock."""
    return [
        {"case": case, "method": method, "asked_peak": peak, "mock": mock}
        | {"pull_x": float(x), "pull_y": float(y)}
        for mock, (x, y) in enumerate(pulls)
    ]


def recover_sizes(
    mocks: int, spots: int, peak: float, background: float, seed: int
) -> tuple[list[dict[str, object]], list[dict[str, object]]]:
    """Rows of the forward model and of the moments for regions at one peak; their pulls."""
    pulls: dict[str, list] = {"noise": [], "equal": [], "moments": []}
    errors: dict[str, list] = {method: [] for method in pulls}
    chi2: dict[str, list] = {method: [] for method in pulls}
    seconds, dropped = dict.fromkeys(pulls, 0.0), dict.fromkeys(pulls, 0)
    for mock in range(mocks):
        rng = np.random.default_rng([seed, mock])
        stamps, clean = make_spots(rng, spots, peak, SHAPE, background=background)
        for weights in ("noise", "equal"):
            began = time.process_time()
            fit = fit_spots(stamps, read_noise=READ_NOISE, weights=weights)
            seconds[weights] += time.process_time() - began
            error = np.array([fit.sigma_x_error, fit.sigma_y_error])
            found = np.array([fit.sigma_x, fit.sigma_y])
            pulls[weights].append((found - SHAPE[:2]) / error)
            errors[weights].append(error)
            chi2[weights].append(fit.chi2 / fit.dof)
            dropped[weights] += int(np.sum(~fit.used))
        began = time.process_time()
        noisy = measure_moments(stamps, background=background, read_noise=READ_NOISE)
        seconds["moments"] += time.process_time() - began
        dropped["moments"] += int(np.sum(~noisy.used))
        widths = noisy.mean_widths()
        truth = measure_moments(clean, background=background).mean_widths()
        error = np.array(widths[2:4])
        pulls["moments"].append((np.array(widths[:2]) - truth[:2]) / error)
        errors["moments"].append(error)
        chi2["moments"].append(np.nan)
    rows = []
    for method in pulls:
        row: dict[str, object] = {"case": "size", "method": method, "spots": spots}
        row |= {"mocks": mocks, "peak": peak, "background": background}
        row |= {"truth_x": SHAPE.sigma_x, "truth_y": SHAPE.sigma_y}
        error = np.mean(errors[method], axis=0)
        row |= {"error_x": error[0], "error_y": error[1]}
        row |= summarise(np.array(pulls[method]))
        row |= {"chi2_dof": np.mean(chi2[method])}
        row |= {"dropped": dropped[method] / (mocks * spots)}
        row |= {"spots_per_s": round(mocks * spots / seconds[method])}
        rows.append(row)
    single = [
        one
        for method, found in pulls.items()
        for one in list_pulls("size", method, peak, np.array(found))
    ]
    return rows, single


def true_widths(peak: float, bend: bool) -> Shape:
    """Widths at a peak: linear growth, and from `BEND` on a sharp one."""
    beyond = 1e-6 * max(peak - BEND, 0.0) if bend else 0.0
    wide = [
        width * (1 + 0.01 * slope * peak / 50e3) + beyond
        for width, slope in zip(SHAPE[:2], SLOPES, strict=True)
    ]
    return Shape(*wide)


def climb(
    rng: np.random.Generator,
    spots: int,
    widths: Shape | Callable[[float], Shape],
    weights: str,
    **more: object,
) -> list[SpotFit]:
    """Fits of a ladder of peaks."""
    return [
        fit_spots(
            make_spots(rng, spots, peak, widths, **more)[0],
            read_noise=READ_NOISE,
            weights=weights,
        )
        for peak in LADDER
    ]


def recover_slopes(
    mocks: int, spots: int, weights: str, bend: bool, seed: int
) -> tuple[dict[str, object], list[dict[str, object]]]:
    """Row of ladders with known slopes, and pulls; errors are those with the range's effect."""
    pulls, errors, highest = [], [], []
    for mock in range(mocks):
        fits = climb(
            np.random.default_rng([seed, mock]),
            spots,
            partial(true_widths, bend=bend),
            weights,
        )
        peaks = [fit.peak for fit in fits]
        along = (
            bf_slopes(peaks, [f.sigma_x for f in fits], [f.sigma_x_error for f in fits]),
            bf_slopes(peaks, [f.sigma_y for f in fits], [f.sigma_y_error for f in fits]),
        )
        pulls.append(
            [
                (one.slope - truth) / one.total_error
                for one, truth in zip(along, SLOPES, strict=True)
            ]
        )
        errors.append([one.total_error for one in along])
        highest.append(max(one.high for one in along))
    row: dict[str, object] = {
        "case": "slope_bend" if bend else "slope",
        "method": weights,
    }
    row |= {"spots": spots, "mocks": mocks, "peak": float(np.median(highest))}
    row |= {"background": 100.0, "truth_x": SLOPES[0], "truth_y": SLOPES[1]}
    error = np.mean(errors, axis=0)
    row |= {"error_x": error[0], "error_y": error[1]}
    single = list_pulls(str(row["case"]), weights, np.nan, np.array(pulls))
    return row | summarise(np.array(pulls)), single


def fit_wings(spots: int, weights: str, seed: int) -> list[dict[str, object]]:
    """Rows of Moffat spots along the ladder, and of the slope that they feign."""
    rng = np.random.default_rng(seed)
    fits = climb(rng, spots, SHAPE, weights, profile=moffat)
    rows: list[dict[str, object]] = []
    for peak, fit in zip(LADDER, fits, strict=True):
        row: dict[str, object] = {"case": "moffat", "method": weights, "spots": spots}
        row |= {"mocks": 1, "peak": peak, "background": 100.0}
        row |= {"truth_x": SHAPE.sigma_x, "truth_y": SHAPE.sigma_y}
        row |= {"found_x": fit.sigma_x, "found_y": fit.sigma_y}
        row |= {"error_x": fit.sigma_x_error, "error_y": fit.sigma_y_error}
        row |= {"scatter_error_x": np.sqrt(fit.scatter_covariance[0, 0])}
        row |= {"chi2_dof": fit.chi2 / fit.dof, "dropped": np.mean(~fit.used)}
        rows.append(row)
    slope = bf_slopes(
        [fit.peak for fit in fits],
        [fit.sigma_x for fit in fits],
        [np.sqrt(fit.scatter_covariance[0, 0]) for fit in fits],
        limits=(LADDER[2] * 0.9, LADDER[-3] * 1.1),
    )
    row = {"case": "moffat_slope", "method": weights, "spots": spots, "mocks": 1}
    row |= {"peak": slope.high, "background": 100.0, "truth_x": 0.0, "truth_y": 0.0}
    row |= {"found_x": slope.slope, "error_x": slope.slope_error}
    rows.append(row | {"chi2_dof": slope.chi2 / slope.dof})
    return rows


def main() -> None:
    """Run all cases, write and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mocks", type=int, default=200)
    parser.add_argument("--spots", type=int, default=300)
    parser.add_argument("-o", "--output", default=str(RESULTS))
    options = parser.parse_args()
    mocks, spots = options.mocks, options.spots
    rows: list[dict[str, object]] = []
    pulls: list[dict[str, object]] = []
    for seed, (peak, background) in enumerate(SIZES, SIZE_SEED):
        found, single = recover_sizes(mocks, spots, peak, background, seed)
        rows += found
        pulls += single
    few = max(spots // 3, 10)
    for weights in ("noise", "equal"):
        for bend, seed in ((False, SLOPE_SEED), (True, BEND_SEED)):
            row, single = recover_slopes(mocks, few, weights, bend, seed)
            rows.append(row)
            pulls += single
        rows += fit_wings(spots, weights, WINGS_SEED)
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table({name: [row.get(name, np.nan) for row in rows] for name in names})
    for name in names:
        if table[name].dtype.kind == "f":
            table[name] = [float(f"{value:.5g}") for value in table[name]]
    print("\n".join(table.pformat(max_width=-1, max_lines=-1)))
    command = f"{COMMAND} --mocks {mocks} --spots {spots}"
    write_results(table, options.output, command)
    listed = Table(rows=pulls)
    for name in ("pull_x", "pull_y"):
        listed[name] = [float(f"{value:.6g}") for value in listed[name]]
    write_results(listed, str(Path(options.output).with_name(PULLS)), command)


if __name__ == "__main__":
    main()
