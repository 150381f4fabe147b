"""Results with what made them: the command and the commit."""

from __future__ import annotations

import subprocess
from typing import Any

from astropy.table import Table

from bfsensor.errors import MeasurementError
from bfsensor.files import written_whole


def write_results(table: Table, path: str, command: str, **more: Any) -> None:
    """Write a table of results as ECSV, with command and commit in its header."""
    table.meta = {"command": command, "commit": commit_here(), **more}
    with written_whole(path, MeasurementError) as beside:
        table.write(beside, format="ascii.ecsv", overwrite=True)


def commit_here() -> str:
    """Short hash of the checkout's commit."""
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    return found.stdout.strip()
