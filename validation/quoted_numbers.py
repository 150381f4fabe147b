"""Numbers that README.md and docs/ quote, computed from the results that they were measured as.

``python -m validation.quoted_numbers`` writes README.md from docs/README.in.md; a test fails where
README.md is not what the results and the template say.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from astropy.table import Table

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "validation" / "results"
TEMPLATE = ROOT / "docs" / "README.in.md"

SITE = "docs/"
"""Where links of README.md find the pages that the template, which lies in docs/, has beside it."""

Rows = Callable[[str], Table]
"""Gives the rows of a results file by its name."""


def read_rows(name: str) -> Table:
    """Rows of a file in validation/results, without its suffix."""
    return Table.read(RESULTS / f"{name}.ecsv", format="ascii.ecsv")


def mesh_error(rows: Rows, device: str, lag: str) -> str:
    """Change of an area [%] between 32 and 64 cells a pixel, light from the back, period 6."""
    table = rows("convergence")
    at = {
        int(r["cells"]): float(r[f"dA_{lag}_um2"])
        for r in table
        if (r["device"], r["period"], r["refine_z"], r["depth_um"]) == (device, 6, 0, 95.0)
    }
    return f"{100 * abs(at[32] / at[64] - 1):.2f}"


def growth(rows: Rows, variant: str, axis: int, part: int) -> str:
    """Growth of stars [% per 50,000 e- in the peak] of ITL's table, or (``part`` 1) its error."""
    from validation.sensor.sensor_stars import slopes

    value = slopes(rows("sensor_ladder"), "itl_sta3800c", variant, 0.0)[axis][part]
    return f"{value:.3f}"


def beside_direct(rows: Rows, axis: str, column: str) -> str:
    """Growth of spots by the sensor over that of the direct simulation, ITL at 80,000 e-."""
    (row,) = (
        r for r in rows("sensor_vs_direct")
        if (r["device"], r["level"], r["axis"]) == ("itl_sta3800c", 80_000.0, axis)
    )  # fmt: skip
    return f"{row[column]:.2f}"


def variance_deficit(rows: Rows, device: str) -> str:
    """Predicted a_00 over the measured one, less 1 [%], nothing fitted."""
    (row,) = (
        r for r in rows("covariances") if (r["setting"], r["x"], r["y"]) == (device, 0, 0)
    )
    return f"{100 * (row['middle'] / row['measured'] - 1):+.1f}"


def predicted_covariance(rows: Rows, setting: str, lag: tuple[int, int]) -> float:
    """Predicted covariance of a lag over the measured one, nothing fitted."""
    (row,) = (
        r for r in rows("covariances") if (r["setting"], r["x"], r["y"]) == (setting, *lag)
    )
    return float(row["middle"] / row["measured"])


def missing_two_away(rows: Rows, pick: Callable[[list[float]], float]) -> str:
    """Part of the measured covariances two pixels away, in x and in y, that is not predicted [%]."""
    ratios = [
        predicted_covariance(rows, setting, lag)
        for setting in ("itl_sta3800c_60", "e2v_ccd250_70")
        for lag in ((2, 0), (0, 2))
    ]
    return f"{100 * (1 - pick(ratios)):.0f}"


def faster(rows: Rows, case: str, sensor: str) -> str:
    """CPU seconds of galsim.SiliconSensor over those of ours."""
    (row,) = (r for r in rows("bench_sensor") if (r["case"], r["sensor"]) == (case, sensor))
    return f"{1 / row['ratio']:.1f}"


def level_seconds(rows: Rows, cells: int) -> str:
    """CPU seconds of a level of a table, potential and boundaries, ITL."""
    (row,) = (
        r for r in rows("benchmark") if (r["device"], r["cells"]) == ("itl_sta3800c", cells)
    )
    return f"{row['setup_cpu_s'] + row['solve_cpu_s'] + row['trace_cpu_s']:.1f}"


def null_p_values(rows: Rows) -> np.ndarray:
    """p-values of all recorded campaigns in which nothing was left out, of all versions."""
    found = [np.asarray(rows("diagnose_nulls")["p"], float)]
    for name in ("challenge_trials", "challenge_pixels"):
        table = rows(name)
        found.append(np.asarray(table["p_value"][table["kind"] == "null"], float))
    values = np.concatenate(found)
    return values[np.isfinite(values)]


@cache
def _numbers() -> dict[str, Callable[[Rows], str]]:
    own = "same physics"
    return {
        "mesh itl 00": lambda r: mesh_error(r, "itl_sta3800c", "00"),
        "mesh e2v 00": lambda r: mesh_error(r, "e2v_ccd250", "00"),
        "mesh e2v 10": lambda r: mesh_error(r, "e2v_ccd250", "10"),
        "growth galsim x": lambda r: growth(r, "galsim", 0, 0),
        "growth galsim y": lambda r: growth(r, "galsim", 1, 0),
        "growth ours x": lambda r: growth(r, own, 0, 0),
        "growth ours y": lambda r: growth(r, own, 1, 0),
        "growth error": lambda r: growth(r, own, 0, 1),
        "direct x": lambda r: beside_direct(r, "x", "ratio"),
        "direct y": lambda r: beside_direct(r, "y", "ratio"),
        "direct error": lambda r: beside_direct(r, "x", "ratio_error"),
        "deficit itl": lambda r: variance_deficit(r, "itl_sta3800c_60"),
        "deficit e2v": lambda r: variance_deficit(r, "e2v_ccd250_70"),
        "faster silicon": lambda r: faster(r, "star 1e6", "silicon"),
        "faster table": lambda r: faster(r, "star 1e6", "brighter_fatter"),
        "level 16": lambda r: level_seconds(r, 16),
        "level 32": lambda r: level_seconds(r, 32),
        "least two away": lambda r: missing_two_away(r, max),
        "most two away": lambda r: missing_two_away(r, min),
        "neighbour at -30 V": lambda r: f"{predicted_covariance(r, 'seed B', (1, 0)):.1f}",
        "nulls": lambda r: str(len(null_p_values(r))),
        "alarms": lambda r: str(int((null_p_values(r) < 0.01).sum())),
    }  # fmt: skip


def quoted(rows: Rows = read_rows) -> dict[str, str]:
    """Give every number by its name, as it is printed."""
    return {name: make(rows) for name, make in _numbers().items()}


def render(template: str, numbers: dict[str, str]) -> str:
    """Fill in ``{{ name }}``; links of the template, relative to docs/, become the root's.

    Raises
    ------
    KeyError
        A name that is no number, or a number that the template does not quote.
    """
    used = set(re.findall(r"\{\{ ([^}]+) \}\}", template))
    if used != set(numbers):
        raise KeyError(f"not quoted or not known: {sorted(used ^ set(numbers))}")
    text = re.sub(r"\{\{ ([^}]+) \}\}", lambda m: numbers[m.group(1)], template)
    text = re.sub(r"\]\((?!https?:|#|\.\./)([^)]+)\)", rf"]({SITE}\1)", text)
    return text.replace("](../", "](")


def main() -> None:
    """Write README.md."""
    (ROOT / "README.md").write_text(render(TEMPLATE.read_text(), quoted()))


if __name__ == "__main__":
    main()
