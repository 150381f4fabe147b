"""What every test needs: processes that tests start import this checkout."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure() -> None:
    """Let child processes find ``bfsensor``, ``tests`` and ``validation`` of this checkout.

    pytest puts the root of the checkout on its own path (``pythonpath`` in pyproject.toml);
    children inherit the environment only.  Without it ``python -m validation.concealed`` and
    Parsl's workers would need an editable install.
    """
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), before]))
