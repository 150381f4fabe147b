"""Results with what made them: the command and the commit."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table, vstack

from bfsensor.errors import MeasurementError
from bfsensor.files import written_whole

RESULTS = Path(__file__).parents[1] / "results"
"""Where files of results are kept."""


def write_results(table: Table, path: str, command: str, **more: Any) -> None:
    """Write a table of results as ECSV, with command and commit in its header."""
    table.meta = {"command": command, "commit": commit_here(), **more}
    with written_whole(path, MeasurementError) as beside:
        table.write(beside, format="ascii.ecsv", overwrite=True)


def replace_run(
    table: Table,
    path: str | Path,
    command: str,
    run: Mapping[str, Any],
    told: Mapping[str, Any],
) -> None:
    """Put the rows of a run in place of those of the same run, and keep all others.

    ``run`` names the columns that tell runs apart and their values; the header has an entry for
    each run, with the commit that made its rows and what else is told of it.
    """
    meta: dict[str, Any] = {}
    if Path(path).exists():
        old = Table.read(path, format="ascii.ecsv")
        meta = {k: v for k, v in old.meta.items() if k not in ("command", "commit")}
        other = np.zeros(len(old), bool)
        for name, value in run.items():
            other |= np.asarray(old[name] != value)
        table = vstack([old[other], table], metadata_conflicts="silent")
    key = " ".join(f"{value}" for value in run.values())
    meta[key] = {"commit": commit_here(), **told}
    write_results(table, str(path), command, **meta)


def commit_here() -> str:
    """Short hash of the checkout's commit."""
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    return found.stdout.strip()
