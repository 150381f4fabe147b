"""Results with what made them: the command and the commit."""

from __future__ import annotations

import subprocess
from typing import Any

from astropy.table import Table


def write_results(table: Table, path: str, command: str, **more: Any) -> None:
    """Write a table of results as ECSV, with command and commit in its header."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    table.meta = {"command": command, "commit": commit.stdout.strip(), **more}
    table.write(path, format="ascii.ecsv", overwrite=True)
