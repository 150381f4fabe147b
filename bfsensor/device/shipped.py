"""Devices and tables that come with the package."""

from __future__ import annotations

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
