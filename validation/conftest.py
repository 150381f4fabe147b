"""Notebooks find this checkout, from whichever folder they run and however it is installed."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = str(Path(__file__).resolve().parents[1])


def pytest_configure() -> None:
    """Put the checkout on the path of the kernels that run notebooks."""
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if ROOT not in before:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [ROOT, *before]))
