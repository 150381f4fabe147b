"""Folder of the devices and tables that come with the package, and suggestions for wrong names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from bfsensor.errors import BFSensorError


def tables_dir() -> Path:
    """Find the folder of the devices and tables that come with the package.

    Returns
    -------
    folder : Path
        The folder ``tables`` in the installed package, or beside the package in a checkout.

    Raises
    ------
    BFSensorError
        The folder is missing: the installation is incomplete.

    Examples
    --------
    >>> (tables_dir() / "itl_sta3800c" / "device.toml").is_file()
    True
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "tables", package.parent / "tables"):
        if folder.is_dir():
            return folder
    raise BFSensorError(
        f"the tables of bfsensor are missing beside {package}: reinstall the package"
    )


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """Return the end of an error message that suggests known names like a wrong one.

    The text is empty where no known name is like it.

    Examples
    --------
    >>> did_you_mean("itl_sta380", ["itl_sta3800c", "e2v_ccd250"])
    '; did you mean itl_sta3800c?'
    """
    known = list(known)
    close = difflib.get_close_matches(given.lower(), known, 3)
    # difflib's similarity of a part, such as 'e2v', to the whole name is below its cut.
    close = close or [name for name in known if given and given.lower() in name]
    return f"; did you mean {' or '.join(close)}?" if close else ""
