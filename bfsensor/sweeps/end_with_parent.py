"""Run a Python script that ends with the process that started it.

``python -m bfsensor.sweeps.end_with_parent SCRIPT`` is how Parsl's interchange is started: by itself
it, and with it its workers, would go on when the process that asked for them is killed.
"""

from __future__ import annotations

import os
import runpy
import sys
import threading
import time

POLL = 1.0
"""Seconds between two looks at the parent.  Chosen: a look costs a microsecond; with 2, a script goes on
for a second longer."""


def main() -> None:
    """Run the script that the first argument names, and end when the parent has ended."""
    parent = os.getppid()

    def watch() -> None:
        # An orphan has another parent.
        while os.getppid() == parent:
            time.sleep(POLL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    sys.argv = sys.argv[1:]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
