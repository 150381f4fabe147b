"""Diagnose sealed cases by the command, read truths that were committed to, and keep rows by set."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from astropy.table import Table, vstack

from validation.common.run_header import commit_here
from validation.common.write_results import write_results


def diagnose_case(given: Sequence[str], device: str, out: Path) -> None:
    """Run ``bfsensor diagnose GIVEN --baseline DEVICE -o OUT`` on one thread, and keep its CPU time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "bfsensor", "diagnose", *given, "--baseline", device, "-o", str(out)],
        capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    out.mkdir(parents=True, exist_ok=True)
    (out / "cost.json").write_text(json.dumps({"cpu_s": cpu, "commit": commit_here()}))
    click.echo(f"{out.name}: {cpu:.0f} CPU s; {(done.stdout or done.stderr)[:160]}")


def committed_truth(path: Path, digest: str) -> dict[str, Any]:
    """Read a truth; raises ClickException if its SHA-256 is not the one committed to."""
    text = path.read_bytes()
    if hashlib.sha256(text).hexdigest() != digest:
        raise click.ClickException(f"{path} is not the truth that was committed to")
    truth: dict[str, Any] = json.loads(text)
    return truth


def holds(told: Mapping[str, Any], value: float) -> bool:
    """Whether a parameter's 95 % interval in report.json holds a value; open ends have no limit.

    Examples
    --------
    >>> holds({"lo95": 1.0, "hi95": 2.0}, 2.5), holds({"lo95": 1.0, "hi95": 2.0, "open95": ["hi"]}, 2.5)
    (False, True)
    """
    open_ = told.get("open95", ())
    return ("lo" in open_ or told["lo95"] <= value) and (
        "hi" in open_ or value <= told["hi95"]
    )


def keep_rows(rows: list[dict[str, Any]], results: Path, command: str, name: str) -> None:
    """Write the rows of a set in place of those that a table has of it, and print them."""
    table = Table(rows)
    if results.exists():
        old = Table.read(results, format="ascii.ecsv")
        table = vstack([old[old["set"] != name], table], metadata_conflicts="silent")
    cost = float(sum(r["cpu_s"] for r in rows))
    write_results(table, results, command, added=True, cpu_s=cost)
    for row in rows:
        click.echo(json.dumps(row))
