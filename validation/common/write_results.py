"""Results as ECSV files, with what made them in the header."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table, vstack

from bfsensor.errors import MeasurementError
from bfsensor.files import written_whole
from validation.common.run_header import OF_A_RUN, run_header

RESULTS = Path(__file__).parents[1] / "results"
"""Where files of results are kept."""


def write_results(
    table: Table, path: str | Path, command: str, *, added: bool = False, **more: Any
) -> None:
    """Write a table of results as ECSV, with what made it in the header.

    Parameters
    ----------
    table : Table
        All rows of the file.
    path : path
        Of the file; it is replaced whole.
    command : str
        That makes the rows.
    added : bool
        Whether the table holds the rows that the file had and new ones: the header then keeps
        what made the earlier ones.
    **more
        Further entries of the header; ``cpu_s`` in place of those of the process.
    """
    there = (
        Table.read(path, format="ascii.ecsv").meta if added and Path(path).exists() else {}
    )
    table.meta = {**run_header(command, there=there), **more}
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
    each run, with what made its rows and what else is told of it.
    """
    meta: dict[str, Any] = {}
    if Path(path).exists():
        old = Table.read(path, format="ascii.ecsv")
        meta = {k: v for k, v in old.meta.items() if k not in OF_A_RUN}
        other = np.zeros(len(old), bool)
        for name, value in run.items():
            other |= np.asarray(old[name] != value)
        table = vstack([old[other], table], metadata_conflicts="silent")
    key = " ".join(f"{value}" for value in run.values())
    meta[key] = {**run_header(command), **told}
    write_results(table, path, command, **meta)
