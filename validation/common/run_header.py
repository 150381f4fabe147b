"""What made a file of results: command, commit, date, machine, versions and CPU seconds.

Nothing is imported from ``bfsensor``: the makers of concealed campaigns, which share no code with
the package, write this header too.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ("bfsensor", "numpy", "scipy", "numba", "galsim", "astropy")
"""Whose versions are kept: what numbers can depend on."""

OF_A_RUN = ("command", "commit", "date", "machine", "versions", "cpu_s")
"""Entries of the header that say what one run was."""

_BEGAN = datetime.now(UTC)


def run_header(command: str, *, there: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Say what this run is, as the header of the file that it writes.

    Parameters
    ----------
    command : str
        That makes the rows.
    there : mapping, optional
        Header of the file, if this run adds to its rows.  The runs that made those are kept.

    Returns
    -------
    header : dict
        ``command``; ``commit`` of the checkout; ``date``, when the process began (UTC); ``machine``,
        processor and cores; ``versions`` of Python and of :data:`PACKAGES`; ``cpu_s``, CPU seconds of
        the process so far and of the child processes that have ended; ``earlier``, if rows are of
        earlier runs: the same entries of each, as far as it wrote them.
    """
    mine = {
        "command": command,
        "commit": commit_here(),
        "date": _BEGAN.isoformat(timespec="seconds"),
        "machine": f"{processor()}, {os.cpu_count()} cores",
        "versions": versions(),
        "cpu_s": round(sum(os.times()[:4]), 1),
    }
    runs = [*there.get("earlier", ()), there] if there else []
    # A run that writes its file row by row finds its own header there: that is no earlier run.
    one = {"commit": mine["commit"], "date": mine["date"]}
    earlier = [
        {name: run[name] for name in OF_A_RUN if name in run}
        for run in runs
        if {name: run.get(name) for name in one} != one
    ]
    return {**mine, "earlier": earlier} if earlier else mine


def commit_here() -> str:
    """Short hash of the checkout's commit."""
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    return found.stdout.strip()


@cache
def processor() -> str:
    """Model of the processor, as the system names it."""
    listed = Path("/proc/cpuinfo")
    lines = listed.read_text().splitlines() if listed.exists() else []
    models = [
        line.partition(":")[2].strip() for line in lines if line.startswith("model name")
    ]
    return models[0] if models else platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Versions of Python and of the packages, as they are loaded or else installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            installed = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed = "not installed"
        # A checkout on the path need not be the installed package.
        found[name] = getattr(sys.modules.get(name), "__version__", installed)
    return found
