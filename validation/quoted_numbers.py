"""Numbers that README.md and docs/ quote, computed from the results that they were measured as.

A page holds a number between two comments, which a reader of the page does not see::

    the area differs by <!--=mesh itl 00-->0.21<!--/--> %

``python -m validation.quoted_numbers`` writes all numbers into their places in README.md and docs/;
a test fails where a page does not say what the results say. A page under docs/ ends with the place
``results``, which lists the files that its numbers come from and since when each is stale.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.table import Row, Table

from validation.challenge.quoted import RAW_FRAMES
from validation.concealed.goals import QUOTED, quoted_goal
from validation.correction.quoted import CORRECTED
from validation.index import Age, read_ages, read_claims
from validation.silicon.counts import SILICON_CASES
from validation.silicon.quoted import SILICON_PIECES

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "validation" / "results"
INDEX = ROOT / "validation" / "README.md"

PLACE = re.compile(r"<!--=([^>]+?)-->(.*?)<!--/-->", re.S)
"""Where a page quotes: the name of a number, and what stands there."""

SOURCES = "results"
"""Name of the place at the end of a page that lists files of results."""

ITL, E2V = "itl_sta3800c", "e2v_ccd250"
DEVICES = {"itl": ITL, "e2v": E2V}

MEASURED_SLOPES = {
    "A": (0.71, 0.94), "B": (1.37, 1.62), "C": (0.68, 0.97),
}  # fmt: skip
"""Slopes of spots in x and y [% per 50,000 e-] that Lage, Bradshaw & Tyson (2017) measured, figure 9."""

M_REQUIRED, C_REQUIRED = 1e-3, 1e-4
"""Biases of shear that weak lensing allows for: Lage, Bradshaw & Tyson (2017), introduction."""

Rows = Callable[[str], Table]
"""Gives the rows of a results file by its name."""


class Quoted(NamedTuple):
    """A number as it is printed, and the files of results that it was computed from."""

    text: str
    results: frozenset[str]


def read_rows(name: str) -> Table:
    """Rows of a file in validation/results, without its suffix."""
    return Table.read(RESULTS / f"{name}.ecsv", format="ascii.ecsv")


def select(table: Table, **values: object) -> Table:
    """Rows that have these values."""
    keep = np.ones(len(table), bool)
    for name, value in values.items():
        keep &= np.asarray(table[name] == value)
    return table[keep]


def one(table: Table, **values: object) -> Row:
    """The only row that has these values."""
    (row,) = select(table, **values)
    return row


def span(values: Iterable[float], form: str) -> str:
    """Least and largest of some values: ``0.80 to 0.95``."""
    low, high = (f"{f(values):{form}}" for f in (np.min, np.max))
    return low if low == high else f"{low} to {high}"


# -- tables and meshes --------------------------------------------------------------------------


def mesh_error(rows: Rows, device: str, lag: str) -> str:
    """Change of an area [%] between 32 and 64 cells a pixel, light from the back, period 6."""
    table = rows("convergence")
    at = {
        int(r["cells"]): float(r[f"dA_{lag}_um2"])
        for r in table
        if (r["device"], r["period"], r["refine_z"], r["depth_um"]) == (device, 6, 0, 95.0)
    }
    return f"{100 * abs(at[32] / at[64] - 1):.2f}"


def sweep_error(rows: Rows, device: str, cells: int, lag: str) -> float:
    """Difference of an a_ij on so many cells a pixel from 64 [%], without its sign."""
    at = {
        n: float(one(rows("sweep_mesh"), device=device, cells=n)[f"a_{lag}_per_e"])
        for n in (cells, 64)
    }
    return 100 * abs(at[cells] / at[64] - 1)


def sweep_worst(rows: Rows, cells: int) -> str:
    """Largest difference of a nearest a_ij of both devices from 64 cells a pixel [%]."""
    lags = ("00", "10", "01", "11")
    worst = max(sweep_error(rows, d, cells, lag) for d in DEVICES.values() for lag in lags)
    return f"{worst:.1f}"


def level_seconds(rows: Rows, cells: int) -> str:
    """CPU seconds of a level of a table, potential and boundaries, ITL."""
    row = one(rows("benchmark"), device=ITL, cells=cells)
    return f"{row['setup_cpu_s'] + row['solve_cpu_s'] + row['trace_cpu_s']:.1f}"


def shipped(rows: Rows, device: str, what: str, at: float | None = None) -> float:
    """What a shipped table says of itself."""
    table = select(rows("shipped_tables"), device=device, what=what)
    return float((table if at is None else select(table, at=at))[0]["value"])


def beyond_table(rows: Rows, sigma: float) -> str:
    """Growth of a star that tables of 4 pixels miss, the larger of x and y [%]."""
    row = one(rows("growth_beyond"), sigma_pixel=sigma)
    return f"{max(row['missed_x'], row['missed_y']):.0f}"


def depth_response(rows: Rows, device: str, column: str) -> str:
    """Area lost by a filled pixel in light that converts at 10 um, over that at 99 um."""
    table = select(rows("sensor_depth"), device=device)
    at = [1 - one(table, height_um=z)[column] for z in (10.0, 99.0)]
    return f"{at[0] / at[1]:.2f}"


def over_shipped_by_galsim(rows: Rows) -> str:
    """How much stronger ITL's device is than GalSim's table, at the centre [%]."""
    row = one(rows("compare_published"), device=ITL, i=0, j=0)
    return f"{100 * (row['ours/theirs'] - 1):.0f}"


def derivative_errors(rows: Rows, device: str) -> np.ndarray:
    """Errors of the response's derivatives by a device's quantities [%], smallest first."""
    table = select(rows("device_derivatives"), device=device, refine_z=1)
    return 100 * np.sort(table["error_moved"])


def derivative_cost(rows: Rows, device: str) -> str:
    """Time of all derivatives over that of one solution."""
    row = select(rows("device_derivatives"), device=device, refine_z=1)[0]
    return f"{row['derivatives_s'] / row['solve_s']:.1f}"


# -- sensors ------------------------------------------------------------------------------------


def growth(rows: Rows, variant: str, axis: int, part: int) -> str:
    """Growth of stars [% per 50,000 e- in the peak] of ITL's table, or (``part`` 1) its error."""
    from validation.sensor.sensor_stars import slopes

    value = slopes(rows("sensor_ladder"), ITL, variant, 0.0)[axis][part]
    return f"{value:.3f}"


def beside_direct(rows: Rows, axis: str, column: str, level: float = 80_000.0) -> str:
    """Growth of spots by the sensor over that of the direct simulation, ITL."""
    row = one(rows("sensor_vs_direct"), device=ITL, level=level, axis=axis)
    return f"{row[column]:.2f}"


def faster(rows: Rows, case: str, sensor: str) -> str:
    """CPU seconds of galsim.SiliconSensor over those of ours."""
    ratio = 1 / one(rows("bench_sensor"), case=case, sensor=sensor)["ratio"]
    return f"{ratio:.1f}" if ratio < 10 else f"{ratio:.0f}"


def on_two_threads(rows: Rows, case: str, sensor: str) -> str:
    """Time on the clock with one thread over that with two."""
    return f"{one(rows('bench_sensor'), case=case, sensor=sensor)['ratio']:.2f}"


def correction_left(rows: Rows, sensor: str, name: str) -> str:
    """Slope of stars of 1.5 pixel after a correction [% of that before], in x and y."""
    from validation.correction.correction_round_trip import residuals

    table = rows("correction_round_trip")
    left = [residuals(table, sensor, 1.5, name, axis)[0] for axis in "xy"]
    return ", ".join(f"{value:+.0f}" for value in left)


def shear(rows: Rows, model: str | None, part: str, band: str = "r") -> str:
    """Bias of shear that a correction with a model leaves, over what lensing allows for."""
    from validation.psf_requirement.psf_requirement import mean_change
    from validation.psf_requirement.shear_bias import shear_bias

    size, shape = (
        mean_change(rows("psf_requirement"), "whole", name, less=model, band=band)[0]
        for name in ("size", "e1")
    )
    bias = shear_bias(size, shape)
    value = abs(bias.m) / M_REQUIRED if part == "m" else abs(bias.c) / C_REQUIRED
    return f"{value:.1f}" if value >= 0.1 else f"{value:.2f}"


def smaller_stars(rows: Rows) -> str:
    """How much smaller faint stars are by Einstein's relation than in GalSim [% of their sigma]."""
    return f"{-wider_than_galsims(rows, 'whole'):.0f}"


def device_stars(rows: Rows) -> str:
    """How far the width of faint stars with the device's diffusion is from GalSim's [%]."""
    return f"{abs(wider_than_galsims(rows, 'wide diffusion')):.1f}"


def wider_than_galsims(rows: Rows, model: str) -> float:
    """How much wider faint stars of a model are than in GalSim [% of their sigma]."""
    table = select(rows("psf_requirement"), peak=1e4, sky=800.0, band="r")
    trace = [np.mean(select(table, model=name)["trace"]) for name in (model, "GalSim")]
    return float(100 * (np.sqrt(trace[0] / trace[1]) - 1))


# -- flats, spots, electrons --------------------------------------------------------------------


def variance_deficit(rows: Rows, device: str) -> str:
    """Predicted a_00 over the measured one, less 1 [%], nothing fitted."""
    return f"{100 * (predicted_covariance(rows, device, (0, 0)) - 1):+.1f}"


def predicted_covariance(rows: Rows, setting: str, lag: tuple[int, int]) -> float:
    """Predicted covariance of a lag over the measured one, nothing fitted."""
    row = one(rows("covariances"), setting=setting, x=lag[0], y=lag[1])
    return float(row["middle"] / row["measured"])


def seed_hypothesis(rows: Rows, hypothesis: str, kind: str, **where: object) -> Row:
    """Row of a fit of the seed paper's settings under a hypothesis."""
    return one(rows("device_hypotheses"), run=f"seed, {hypothesis}", kind=kind, **where)


def readout_evidence(rows: Rows) -> str:
    """Twice the logarithm of the evidence that terms of the readout add in the seed paper's settings."""
    with_it, without = (
        float(seed_hypothesis(rows, name, "fit")["pull"])
        for name in ("readout", "flat of 40,000 e-")
    )
    return f"{with_it - without:.0f}"


def neighbour_at_30(rows: Rows, hypothesis: str, name: str) -> str:
    """Fitted over measured covariance with the neighbour in x at -30 V, with its error."""
    row = seed_hypothesis(rows, hypothesis, "lag", name=name, i=1, j=0)
    return f"{row['value']:.2f} ± {row['error']:.2f}"


def spots_mesh(rows: Rows, level: int) -> str:
    """Growth by boundaries on 8 cells over that on 32, less 1 [%], in x and y."""
    table = select(rows("boundary_growth"), level=1000.0 * level)
    coarse, fine = (one(table, source=f"{n} cells") for n in (8, 32))
    return ", ".join(f"{100 * (coarse[a] / fine[a] - 1):+.0f}" for a in "xy")


def covariance_chi2(rows: Rows, setting: str) -> str:
    """Chi-square of the predicted covariances of 24 lags, without the variance."""
    table = select(rows("covariances"), setting=setting)
    table = table[(table["x"] > 0) | (table["y"] > 0)]
    pulls = (table["middle"] - table["measured"]) / table["error"]
    return f"{np.sum(pulls**2):.1f} of {len(table)}"


def missing_two_away(rows: Rows, pick: Callable[[list[float]], float]) -> str:
    """Part of the measured covariances two pixels away, in x and in y, that is not predicted [%]."""
    ratios = [
        predicted_covariance(rows, setting, lag)
        for setting in ("itl_sta3800c_60", "e2v_ccd250_70")
        for lag in ((2, 0), (0, 2))
    ]
    return f"{100 * (1 - pick(ratios)):.0f}"


def spot_slopes(rows: Rows, setting: str) -> str:
    """Slope of simulated spots over the measured one, in x and y, nothing fitted."""
    table = select(rows("spot_slopes"), setting=setting, weights="equal", unit="paper")
    ratios = [
        one(table, axis=axis)["slope"] / measured
        for axis, measured in zip("xy", MEASURED_SLOPES[setting], strict=True)
    ]
    return ", ".join(f"{ratio:.2f}" for ratio in ratios)


def spot_slope_errors(rows: Rows) -> str:
    """Relative errors of the slopes of six simulated spots [%]."""
    table = select(rows("spot_slopes"), weights="equal")
    return span(100 * table["error"] / table["slope"], ".1f")


def full_wells(rows: Rows, case: str) -> str:
    """Full well over the measured saturation, barrier of 1.1 V, below the plateau of the latter."""
    table = select(rows("saturation_causes"), case=case)
    table = table[~((table["gate_low_V"] == -8) & (table["gate_high_V"] > 3))]
    return span(table["barrier_1.1_V"] / table["measured_e"], ".2f")


def width_pull(rows: Rows) -> str:
    """Largest difference of a width of electrons in large steps from Einstein's relation [errors]."""
    table = select(rows("transport_widths"), engine="steps")
    table = table[table["height_um"] > 5]  # lower, the wells hold them together
    pulls = [(table[f"sigma_{x}"] - table["einstein"]) / table["error"] for x in "xy"]
    return f"{np.max(np.abs(pulls)):.1f}"


def electron_us(rows: Rows, variant: str) -> str:
    """CPU time of an electron [us]."""
    return f"{one(rows('transport_shares'), variant=variant)['cpu_us']:.0f}"


def edge_chi2(rows: Rows) -> str:
    """Chi-square of stars drawn near an edge against its field."""
    table = select(rows("edge_sensor"), kind="star")
    pulls = (table["found"] - table["expected"]) / table["error"]
    return f"{np.sum(pulls**2):.1f} of {len(table)}"


# -- fits and intervals -------------------------------------------------------------------------


def spot_coverage(rows: Rows, case: str, errors: int) -> str:
    """Share of spot sizes or slopes whose truth lies within so many stated errors [%]."""
    table = rows("spot_mocks")
    own = [r for r in table if str(r["case"]).startswith(case) and r["method"] != "moments"]
    return f"{100 * np.mean([r[f'within_{errors}_{x}'] for r in own for x in 'xy']):.0f}"


def flat_coverage(rows: Rows, errors: str) -> str:
    """Share of all parameters of flats whose truth lies within so many stated errors [%]."""
    return f"{100 * np.mean(rows('flat_mocks')[f'within_{errors}_sigma']):.0f}"


def fit_coverage(rows: Rows, way: str, share: str, name: str = "") -> str:
    """Share of truths within the intervals of fitted devices [%].

    Of the parameters of a name; by default the least and largest share of the three
    best-determined combinations over devices and kinds of truth.
    """
    table = select(rows("fit_recovery"), misstated=1.0, way=way)
    if name:
        table = select(table, name=name)
        return f"{100 * np.average(table[share], weights=table['mocks']):.0f}"
    found = []
    for device, truth in dict.fromkeys(zip(table["device"], table["truth"], strict=True)):
        for own in ("own 1", "own 2", "own 3"):
            part = select(table, device=device, truth=truth, name=own)
            found.append(100 * np.average(part[share], weights=part["mocks"]))
    return span(found, ".0f")


def fit_seconds(rows: Rows, run: str) -> str:
    """CPU seconds of a whole fit of the a_ij of 2019."""
    return f"{rows('device_fit').meta[run]['cpu_s']:.0f}"


# -- diagnosis ----------------------------------------------------------------------------------


def null_p_values(rows: Rows) -> np.ndarray:
    """p-values of all recorded campaigns in which nothing was left out, of all versions."""
    found = [np.asarray(rows("diagnose_nulls")["p"], float)]
    for name in ("challenge_trials", "challenge_pixels"):
        table = rows(name)
        found.append(np.asarray(table["p_value"][table["kind"] == "null"], float))
    values = np.concatenate(found)
    return values[np.isfinite(values)]


def cpu_seconds(rows: Rows, name: str) -> str:
    """CPU seconds of a command that the documentation shows."""
    seconds = one(rows("durations"), name=name)["cpu_s"]
    return f"{seconds:.1f}" if seconds < 2 else f"{seconds:.0f}"


@cache
def _numbers() -> dict[str, Callable[[Rows], str]]:
    own, column = "same physics", "one gate, column, 32 cells"
    star, pooled = "star 1e7", "pooled 1e7"
    numbers: dict[str, Callable[[Rows], str]] = {
        "sweep itl 10": lambda r: f"{sweep_error(r, ITL, 16, '10'):.0f}",
        "sweep itl 01": lambda r: f"{sweep_error(r, ITL, 16, '01'):.0f}",
        "sweep e2v 10": lambda r: f"{sweep_error(r, E2V, 16, '10'):.0f}",
        "sweep e2v 01": lambda r: f"{sweep_error(r, E2V, 16, '01'):.0f}",
        "sweep 32": lambda r: sweep_worst(r, 32),
        "sweep 48": lambda r: sweep_worst(r, 48),
        "sweep 48 seconds": lambda r: span(select(r("sweep_mesh"), cells=48)["cpu_s"], ".0f"),
        "growth galsim x": lambda r: growth(r, "galsim", 0, 0),
        "growth galsim y": lambda r: growth(r, "galsim", 1, 0),
        "growth ours x": lambda r: growth(r, own, 0, 0),
        "growth ours y": lambda r: growth(r, own, 1, 0),
        "growth error": lambda r: growth(r, own, 0, 1),
        "direct x": lambda r: beside_direct(r, "x", "ratio"),
        "direct y": lambda r: beside_direct(r, "y", "ratio"),
        "direct error": lambda r: beside_direct(r, "x", "ratio_error"),
        "direct x 150": lambda r: beside_direct(r, "x", "ratio", 150_000.0),
        "direct y 150": lambda r: beside_direct(r, "y", "ratio", 150_000.0),
        "deficit itl": lambda r: variance_deficit(r, "itl_sta3800c_60"),
        "deficit e2v": lambda r: variance_deficit(r, "e2v_ccd250_70"),
        "chi2 itl": lambda r: covariance_chi2(r, "itl_sta3800c_60"),
        "chi2 e2v": lambda r: covariance_chi2(r, "e2v_ccd250_70"),
        "least two away": lambda r: missing_two_away(r, max),
        "most two away": lambda r: missing_two_away(r, min),
        "neighbour at -30 V": lambda r: f"{predicted_covariance(r, 'seed B', (1, 0)):.1f}",
        **{f"spots mesh {n}": partial(spots_mesh, level=n) for n in (20, 80, 150)},
        "seed readout evidence": readout_evidence,
        "seed readout neighbour": lambda r: neighbour_at_30(r, "readout", "areas B, readout"),
        "seed device neighbour": lambda r: neighbour_at_30(r, "flat of 40,000 e-", "areas B"),
        "level 16": lambda r: level_seconds(r, 16),
        "level 32": lambda r: level_seconds(r, 32),
        "iteration": lambda r: f"{max(map(float, r('benchmark')['iteration_error_V'])):.0e}",
        "threads silicon": lambda r: on_two_threads(r, f"two threads, {star}", "silicon"),
        "threads table": lambda r: on_two_threads(r, f"two threads, {star}", "brighter_fatter"),
        "pooled silicon": lambda r: on_two_threads(r, f"two threads, {pooled}", "silicon"),
        "pooled table": lambda r: on_two_threads(r, f"two threads, {pooled}", "brighter_fatter"),
        "tanh at 10 um": lambda r: depth_response(r, ITL, "tanh"),
        "stronger than galsim": over_shipped_by_galsim,
        "area lost 10": lambda r: f"{shipped(r, ITL, 'area lost per 100,000 e-', 1e4):.1f}",
        "area lost 130": lambda r: f"{shipped(r, ITL, 'area lost per 100,000 e-', 1.3e5):.1f}",
        "spot slope errors": spot_slope_errors,
        "wells two gates": lambda r: full_wells(r, "device"),
        "wells one gate": lambda r: full_wells(r, column),
        "width pull": width_pull,
        "steps us": lambda r: electron_us(r, "steps 0.25, 5 um"),
        "scattering us": lambda r: electron_us(r, "scattering"),
        "edge chi2": edge_chi2,
        "template": lambda r: f"{100 * max(r('edge_template_fits')['explained_at_20']):.0f}",
        "fit all 68": lambda r: fit_coverage(r, "draws", "within_68", "all parameters"),
        "fit all 95": lambda r: fit_coverage(r, "draws", "within_95", "all parameters"),
        "fit own 68": lambda r: fit_coverage(r, "draws", "within_68"),
        "fit own 95": lambda r: fit_coverage(r, "draws", "within_95"),
        "tangent own 68": lambda r: fit_coverage(r, "tangent", "within_68"),
        "tangent own 95": lambda r: fit_coverage(r, "tangent", "within_95"),
        "fit seconds itl": lambda r: fit_seconds(r, "itl"),
        "fit seconds e2v": lambda r: fit_seconds(r, "e2v"),
        "flats within 1": lambda r: flat_coverage(r, "1"),
        "flats within 2": lambda r: flat_coverage(r, "1.96"),
        "smaller stars": smaller_stars,
        "device stars": device_stars,
        "shear m": lambda r: shear(r, None, "m"),
        "shear c": lambda r: shear(r, None, "c"),
        "shear m galsim": lambda r: shear(r, "GalSim", "m"),
        "shear c galsim": lambda r: shear(r, "GalSim", "c"),
        "shear m nearest": lambda r: shear(r, "nearest pixels", "m"),
        "shear m linear": lambda r: shear(r, "linear", "m"),
        "shear m depth y": lambda r: shear(r, "no depth", "m", "y"),
        "shear m depth r": lambda r: shear(r, "no depth", "m"),
        "shear m feedback": lambda r: shear(r, "no feedback", "m"),
        "shear m tenth": lambda r: shear(r, "nine tenths", "m"),
        "campaign memory": lambda r: f"{max(r('campaign_memory')['memory_peak_gb']):.2f}",
        "trial sets": lambda r: str(len(set(r("challenge_trials")["set"]))),
        "nulls": lambda r: str(len(null_p_values(r))),
        "alarms": lambda r: str(int((null_p_values(r) < 0.01).sum())),
    }  # fmt: skip
    for short, device in DEVICES.items():
        for lag in ("00", "10", "01", "11"):
            numbers[f"mesh {short} {lag}"] = lambda r, d=device, lag=lag: mesh_error(
                r, d, lag
            )
        numbers |= {
            f"background {short}": lambda r, d=device: (
                f"{shipped(r, d, 'mesh (0,0) on a background [%]'):.1f}"
            ),
            f"superposition {short}": lambda r, d=device: (
                f"{shipped(r, d, 'superposition, star at half full well [%]'):.1f}"
            ),
            f"superposition sky {short}": lambda r, d=device: (
                f"{shipped(r, d, 'superposition, star on a quarter full well [%]'):.1f}"
            ),
            f"at 10 um {short}": lambda r, d=device: depth_response(r, d, "table"),
            f"peer {short}": lambda r, d=device: (
                f"{one(r('benchmark'), device=d, cells=32)['peer_cpu_ratio']:.0f}"
            ),
            f"derivatives {short}": lambda r, d=device: str(len(derivative_errors(r, d))),
            f"derivatives median {short}": lambda r, d=device: (
                f"{np.median(derivative_errors(r, d)):.1f}"
            ),
            f"derivatives worst {short}": lambda r, d=device: (
                f"{derivative_errors(r, d)[-1]:.1f}"
            ),
            f"derivatives cost {short}": lambda r, d=device: derivative_cost(r, d),
        }  # fmt: skip
    for short, sensor in (("silicon", "silicon"), ("table", "brighter_fatter")):
        for case, full in (
            ("", "star 1e6"), (" colour", "star 1e6, wavelengths and angles"), (" 1e7", star),
            (" flat", "flat 512, 1e6 photons"), (" first", "first accumulate 4096"),
            (" areas", "areas 2048"), (" rings", "star 1e6, rings"),
        ):  # fmt: skip
            numbers[f"faster {short}{case}"] = lambda r, c=full, s=sensor: faster(r, c, s)
    for setting in MEASURED_SLOPES:
        numbers[f"spots {setting}"] = lambda r, s=setting: spot_slopes(r, s)
    for case in ("size", "slope"):
        for n in (1, 2):
            numbers[f"{case} within {n}"] = lambda r, c=case, n=n: spot_coverage(r, c, n)
    for short, sensor, name in (
        ("empty edges", "whole", "edges"), ("empty kernel", "whole", "kernel"),
        ("charged edges", "whole", "edges, at 50 ke-"),
        ("charged kernel", "whole", "kernel, flats of 80 ke-"),
        ("linear edges", "linear", "edges"), ("table", "whole", "table"),
        ("table of red light", "y light", "table, y band"),
        ("surface table", "y light", "table"),
    ):  # fmt: skip
        numbers[f"left {short}"] = lambda r, s=sensor, n=name: correction_left(r, s, n)
    numbers.update(CORRECTED)
    numbers.update(SILICON_PIECES)
    numbers.update(SILICON_CASES)
    numbers.update(RAW_FRAMES)
    for short in QUOTED:
        numbers[f"independent {short}"] = lambda r, s=short: quoted_goal(
            r("independent_goals"), s
        )
    for sigma in (1.0, 1.5, 2.5):
        numbers[f"beyond {sigma}"] = lambda r, s=sigma: beyond_table(r, s)
    for kind in ("plain", "tile-compressed"):
        for part in ("headers_s", "pixels_s"):
            numbers[f"campaign {kind} {part}"] = lambda r, k=kind, p=part: (
                f"{one(r('campaign_memory'), files=k)[p]:.{1 if p == 'pixels_s' else 2}f}"
            )
    for name in (
        "small table",
        "whole table",
        "first star",
        "star",
        "make campaign",
        "check",
        "diagnose",
        "spot",
    ):
        numbers[f"cpu {name}"] = lambda r, n=name: cpu_seconds(r, n)
    return numbers


def quoted(rows: Rows = read_rows, names: Iterable[str] | None = None) -> dict[str, Quoted]:
    """Give numbers by their names, by default all, each with the files of results behind it."""
    kept: dict[str, Table] = {}

    def read(name: str) -> Table:
        if name not in kept:
            kept[name] = rows(name)
        used.add(f"{name}.ecsv")
        return kept[name]

    found, known = {}, _numbers()
    for name in known if names is None else names:
        used: set[str] = set()
        found[name] = Quoted(known[name](read), frozenset(used))
    return found


# -- pages --------------------------------------------------------------------------------------


def pages(root: Path = ROOT) -> Iterator[Path]:
    """README.md and the pages of docs/ that quote."""
    for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        if PLACE.search(path.read_text()):
            yield path


def names_in(text: str) -> set[str]:
    """Names of the numbers that a page quotes."""
    return {name for name, _ in PLACE.findall(text)} - {SOURCES}


def render(text: str, numbers: Mapping[str, Quoted], sources: str = "") -> str:
    """Write the numbers of a page, and its list of results, into their places.

    Raises
    ------
    KeyError
        The page names what is no number.
    """
    if unknown := names_in(text) - set(numbers):
        raise KeyError(f"not known: {sorted(unknown)}")

    def fill(found: re.Match[str]) -> str:
        name = found[1]
        return f"<!--={name}-->{sources if name == SOURCES else numbers[name].text}<!--/-->"

    return PLACE.sub(fill, text)


def list_sources(
    page: Path, numbers: Mapping[str, Quoted], ages: Mapping[str, Age], root: Path = ROOT
) -> str:
    """List the files of results that a page quotes: their claim, when made, since when stale."""
    used = sorted(set().union(*(numbers[n].results for n in names_in(page.read_text()))))
    folders = {
        name: claim.folder
        for claim in reversed(read_claims())
        for _, names in claim.commands
        for name in names
    }
    up = "../" * (len(page.relative_to(root).parts) - 1)
    lines = ["", "", "Measured numbers on this page come from these results:", ""]
    for name in used:
        link = f"{up}validation/{folders[name]}/README.md"
        lines.append(f"- `{name}` ([{folders[name]}]({link})), {ages[name]}.")
    return "\n".join([*lines, "", ""])


def write_quotes() -> None:
    """Write numbers and lists of results into all pages.

    Raises
    ------
    KeyError
        A page names what is no number, or no page quotes one.
    """
    numbers, ages = quoted(), read_ages(INDEX.read_text())
    used: set[str] = set()
    for page in pages():
        text = page.read_text()
        used |= names_in(text)
        sources = list_sources(page, numbers, ages) if f"<!--={SOURCES}-->" in text else ""
        page.write_text(render(text, numbers, sources))
    if left := set(numbers) - used:
        raise KeyError(f"not quoted: {sorted(left)}")


if __name__ == "__main__":
    write_quotes()
