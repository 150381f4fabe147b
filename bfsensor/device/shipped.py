"""Devices and tables that come with the package."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from bfsensor.errors import BFSensorError


def tables_dir() -> Path:
    """Find their folder: in a wheel, or beside it in a checkout.

    Returns
    -------
    folder : Path
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "tables", package.parent / "tables"):
        if folder.is_dir():
            return folder
    raise BFSensorError(
        f"the tables of bfsensor are missing beside {package}: reinstall the package"
    )


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """Write what a wrong name was probably meant to be, to stand after a message.

    Examples
    --------
    >>> did_you_mean("e2v", ["itl_sta3800c", "e2v_ccd250"])
    "; did you mean 'e2v_ccd250'?"
    """
    names = list(known)
    close = difflib.get_close_matches(given.lower(), names, 1)
    close += [
        n for n in names if given.lower() in n.split("_") or n.startswith(given.lower())
    ]
    return f"; did you mean {close[0]!r}?" if given and close else ""
