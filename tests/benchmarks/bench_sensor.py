"""Sensors against galsim.SiliconSensor: CPU seconds for the same photons, side by side.

``OMP_NUM_THREADS=1 python tests/benchmarks/bench_sensor.py [--repeats 3] [--only NAME ...] [--missing]
[-o OUT.ecsv]``, from the root of the checkout and on a quiet machine; each measurement is a process
of its own.  ``--only`` runs the jobs whose names begin so, ``--missing`` those that have no row in
OUT.  Rows are written after each job in place of earlier ones of the same job: best and worst of the
repeats, the ratio to GalSim, what is asked for, and the load of the machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.benchmarks.sensor_jobs import JOBS, OURS, PARTS, Job, measure

COMMAND = "python tests/benchmarks/bench_sensor.py"
NAMES = (
    "case", "sensor", "cpu_s", "cpu_s_worst", "ratio", "bounded", "limit", "aim", "bytes",
    "load", "commit",
)  # fmt: skip

Runs = list[dict[str, Any]]


def once(case: str, which: str, threads: int = 1) -> dict[str, Any]:
    """Measure in a fresh process."""
    command = [sys.executable, __file__, "--one", case, which, str(threads)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "2"}
    with tempfile.TemporaryDirectory() as folder:
        if case.startswith("cold"):
            environment["NUMBA_CACHE_DIR"] = folder
        text = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, text=True, check=True
        ).stdout
    return json.loads(text.splitlines()[-1])


def run_job(case: str, job: Job, repeats: int) -> list[dict[str, Any]]:
    """Measure a job with all its sensors, by turns; returns its rows."""
    if job.bounded == "speed-up":
        return [_on_two_threads(case, job, which, repeats) for which in job.sensors]
    runs: dict[str, Runs] = {which: [] for which in job.sensors}
    for _ in range(repeats):
        for which in job.sensors:
            runs[which].append(once(case, which))
    rows = []
    best = {which: min(r["cpu"] for r in found) for which, found in runs.items()}
    for which, found in runs.items():
        ratio = best[which] / best["galsim"] if "galsim" in best else math.nan
        limit, aim = job.asked.get(which, (math.nan, math.nan))
        rows.append({
            "case": case, "sensor": which, "cpu_s": best[which],
            "cpu_s_worst": max(r["cpu"] for r in found), "ratio": ratio,
            "bounded": job.bounded, "limit": limit, "aim": aim,
            "bytes": min(r["bytes"] for r in found),
        })  # fmt: skip
    if case in PARTS:
        rows += [_part(case, which, runs, best) for which in OURS]
    return rows


def _part(case: str, which: str, runs: dict[str, Runs], best: dict[str, float]) -> dict:
    """Row that follows from a job: its slowest call but the first, or the sensor's share."""
    name, (limit, aim) = PARTS[case]
    if "plain" in best:
        mine, theirs = (best[n] - best["plain"] for n in (which, "galsim"))
    else:
        ours, others = (
            [min(times) for times in zip(*(r["parts"] for r in runs[n]), strict=True)][1:]
            for n in (which, "galsim")
        )
        mine, theirs = max(
            zip(ours, others, strict=True), key=lambda pair: pair[0] / pair[1]
        )
    return {
        "case": name, "sensor": which, "cpu_s": mine, "cpu_s_worst": mine,
        "ratio": mine / theirs, "bounded": "ratio", "limit": limit, "aim": aim, "bytes": 0.0,
    }  # fmt: skip


def _on_two_threads(case: str, job: Job, which: str, repeats: int) -> dict[str, Any]:
    """Row of the gain in time on the clock by a second thread."""
    times: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(repeats):
        for threads, found in times.items():
            found.append(once(case.removeprefix("two threads, "), which, threads)["wall"])
    one, two = (min(found) for found in times.values())
    limit, aim = job.asked[which]
    return {
        "case": case, "sensor": which, "cpu_s": two, "cpu_s_worst": max(times[2]),
        "ratio": one / two, "bounded": job.bounded, "limit": limit, "aim": aim, "bytes": 0.0,
    }  # fmt: skip


def verdict(row: dict[str, Any]) -> str:
    """Say whether a row reaches what is asked for."""
    if math.isnan(row["limit"]):
        return ""
    faster = row["bounded"] == "speed-up"
    value = row["ratio" if faster else row["bounded"]]
    aim, limit = (
        value >= row[name] if faster else value <= row[name] for name in ("aim", "limit")
    )
    return "aim" if aim else "met" if limit else "MISSED"


def show(row: dict[str, Any]) -> None:
    """Print a row."""
    ratio = row["ratio"]
    by = f"{ratio:.2f} x" if row["bounded"] == "speed-up" else f"1/{1 / ratio:.2f}"
    print(
        f"{row['case']:40s} {row['sensor']:16s} {row['cpu_s']:9.4f} s (to "
        f"{row['cpu_s_worst']:.4f})  {'' if math.isnan(ratio) else by:10s} "
        f"{verdict(row):6s} {row['bytes']:6.1f} B/pixel  load {row['load']}",
        flush=True,
    )


def read_rows(path: str | None) -> list[dict[str, Any]]:
    """Rows that a file holds already."""
    if not path or not Path(path).exists():
        return []
    from astropy.table import Table

    table = Table.read(path, format="ascii.ecsv")
    if set(table.colnames) != set(NAMES):
        print(f"{path} has other columns: its rows are replaced")
        return []
    return [dict(zip(table.colnames, row, strict=True)) for row in table]


def write_rows(rows: list[dict[str, Any]], path: str, command: str) -> None:
    """Write the rows in the order of the jobs."""
    from astropy.table import Table

    from validation.common.write_results import write_results

    order = [name for case in JOBS for name in (case, PARTS.get(case, ("",))[0])]
    rows = sorted(rows, key=lambda row: order.index(row["case"]))
    table = Table(rows=[[row[name] for name in NAMES] for row in rows], names=NAMES)
    write_results(table, path, command, added=True)


def main() -> None:
    """Run the jobs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3, help="of each measurement")
    parser.add_argument("--only", nargs="+", default=[""], help="beginnings of jobs' names")
    parser.add_argument("--missing", action="store_true", help="skip jobs with rows in OUT")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", help="write the rows to an ECSV file")
    options = parser.parse_args()
    if options.one:
        case, which, threads = options.one
        print(json.dumps(measure(case, which, int(threads))))
        return
    from validation.common.run_header import commit_here

    rows = read_rows(options.output)
    there = {row["case"] for row in rows} if options.missing else set()
    print(f"{os.cpu_count()} cores, best of {options.repeats}")
    for case, job in JOBS.items():
        if case in there or not case.startswith(tuple(options.only)):
            continue
        load = round(os.getloadavg()[0], 2)
        found = run_job(case, job, options.repeats)
        for row in found:
            row |= {"load": load, "commit": commit_here()}
            show(row)
        names = {row["case"] for row in found}
        rows = [row for row in rows if row["case"] not in names] + found
        if options.output:
            write_rows(rows, options.output, f"{COMMAND} --repeats {options.repeats}")


if __name__ == "__main__":
    main()
