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
    """Ask, at the end of an error, for the names that a wrong one is like; '' for none.

    Examples
    --------
    >>> did_you_mean("itl_sta380", ["itl_sta3800c", "e2v_ccd250"])
    '; did you mean itl_sta3800c?'
    """
    known = list(known)
    close = difflib.get_close_matches(given.lower(), known, 3)
    # A part of a name, such as 'e2v', is not like the whole by difflib's measure.
    close = close or [name for name in known if given and given.lower() in name]
    return f"; did you mean {' or '.join(close)}?" if close else ""
