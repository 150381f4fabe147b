"""Provenance of a report: command, time, machine, versions, and hashes of the files it rests on."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bfsensor.checkpoints import code_digest, file_digest

PACKAGES = ("bfsensor", "numpy", "scipy", "astropy", "numba", "galsim")
"""Packages whose versions a report names."""


def files_of(folder: Path, paths: Iterable[Path]) -> dict[str, str]:
    """SHA-256 of files, by their path below a folder, or by their name where they lie elsewhere.

    Parameters
    ----------
    folder : Path
        Folder of the recordings.
    paths : iterable of Path
        Files; those that do not exist are left out.

    Returns
    -------
    dict of str to str
        64 hexadecimal digits by path, sorted.
    """
    root = folder.resolve()
    out = {}
    for path in {p.resolve() for p in paths if p.is_file()}:
        name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
        out[name] = file_digest(path)
    return dict(sorted(out.items()))


def provenance_of(
    command: str, *, seed: int, files: Mapping[str, str], began: float
) -> dict[str, Any]:
    """Make the block 'provenance' of report.json.

    Parameters
    ----------
    command : str
        Command line, or call, that made the report.
    seed : int
        Seed of the noise draws.
    files : mapping of str to str
        SHA-256 of the files that were read: :func:`files_of`.
    began : float
        Value of ``time.monotonic()`` when the diagnosis began.

    Returns
    -------
    dict
        'command', 'seed', 'code' (SHA-256 of the package's source), 'versions' and 'files' are
        the same in a repeated run; 'date' (UTC), 'seconds', 'cpu_seconds' and 'host' are not.
    """
    return {
        "command": command,
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(time.monotonic() - began, 1),
        "cpu_seconds": round(time.process_time(), 1),
        "host": platform.node(),
        "code": code_digest().decode(),
        "versions": {
            "python": platform.python_version(),
            **{p: version(p) for p in PACKAGES},
        },
        "files": dict(files),
    }
