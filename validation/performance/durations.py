"""What the commands that README.md and docs/ show cost, in CPU seconds and on the clock.

``python -m validation.performance.durations`` runs each in an empty folder, in the order of the
pages, and writes a row for each. Kernels are compiled before, as on every run but the first, but for
"first star". CPU seconds count all processes of a command; the clock depends on what else the machine
does.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from astropy.table import Table

from validation.common.write_results import RESULTS, write_results

ROOT = Path(__file__).resolve().parents[2]
TRAP = "campaigns/concealed_0000"
SMALL = "--charges 0,50000,100000 --backgrounds 0,50000 --depths 20,60,100 --no-assess"
COMMANDS = {
    "first star": "python star.py",
    "small table": f"bfsensor table itl_sta3800c {SMALL} -o itl_small.fits",
    "whole table": "bfsensor table itl_sta3800c -o itl.fits",
    "star": "python star.py",
    "make campaign": "python -m validation.concealed make campaigns --class trap_serial --seed 8",
    "check": f"bfsensor check {TRAP}",
    "diagnose": f"bfsensor diagnose {TRAP} -o report",
    "spot": "bfsensor spots itl_sta3800c --set back_bias=-60V --set gate_high=4V --spots 1 -o spots",
}
WARM = ("star", "small table", "make campaign", "diagnose", "spot")
"""Which commands run once before, so that what they use is compiled."""


def run(command: str, folder: Path, **environment: str) -> tuple[float, float]:
    """Seconds on the clock and CPU seconds of a command."""
    head, *rest = command.split()
    start = {
        "python": [sys.executable],
        "bfsensor": [sys.executable, "-m", "bfsensor.cli.main"],
    }
    began, used = time.perf_counter(), os.times()
    subprocess.run(
        [*start[head], *rest], cwd=folder, check=True, stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )  # fmt: skip
    wall, now = time.perf_counter() - began, os.times()
    cpu = sum(now[2:4]) - sum(used[2:4])
    return round(wall, 1), round(cpu, 1)


def make_folder(parent: str, name: str) -> Path:
    """Empty folder with the star of README.md in it."""
    folder = Path(parent) / name
    folder.mkdir()
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    (folder / "star.py").write_text(code)
    return folder


def main() -> None:
    """Run the commands and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as parent:
        folder = make_folder(parent, "first")
        for name in WARM:
            run(COMMANDS[name], folder)
        folder = make_folder(parent, "timed")
        for name, command in COMMANDS.items():
            new = {"NUMBA_CACHE_DIR": str(folder)} if name.startswith("first ") else {}
            wall, cpu = run(command, folder, **new)
            rows.append({"name": name, "command": command, "clock_s": wall, "cpu_s": cpu})
            print(rows[-1], flush=True)
    table = Table(rows)
    path = RESULTS / "durations.ecsv"
    write_results(table, path, "python -m validation.performance.durations")


if __name__ == "__main__":
    main()
