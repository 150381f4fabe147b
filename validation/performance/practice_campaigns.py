"""Practice campaigns diagnosed: what is found, chi-square by channel, time and memory.

``python -m validation.performance.practice_campaigns FOLDER`` runs ``bfsensor diagnose`` on each
campaign of FOLDER in a process of its own, and writes a row for each channel to
``validation/results/practice_campaigns.ecsv``.  The truths are not read.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from astropy.table import Table

from validation.common.write_results import write_results

COMMAND = "python -m validation.performance.practice_campaigns FOLDER"


def diagnose(folder: Path, out: Path) -> tuple[dict, float, float]:
    """Report, CPU seconds and peak memory [GB] of the command on one campaign."""
    begin = time.monotonic()
    code = "from bfsensor.cli.main import main; main()"
    line = [sys.executable, "-c", code, "diagnose", str(folder), "-o", str(out)]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{folder}: bfsensor diagnose ended with {process.returncode}")
    print(f"{folder.name}: {time.monotonic() - begin:.0f} s")
    report = json.loads((out / "report.json").read_text())
    return report, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e6


def main() -> None:
    """Diagnose all and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "-o", "--output", default="validation/results/practice_campaigns.ecsv"
    )
    options = parser.parse_args()
    rows = []
    for campaign in sorted(p.parent for p in options.folder.glob("*/campaign.yaml")):
        with TemporaryDirectory() as out:
            report, cpu, memory = diagnose(campaign, Path(out))
        where = json.dumps(report["location"], separators=(",", ":"))
        print(
            f"  p = {report['p_value']:.2g}, {cpu:.1f} CPU s, {memory:.2f} GB; {report['said']}"
        )
        print(f"  {where}")
        for word, found in report["channels"].items():
            square, dof = found["chi2"], found["dof"]
            print(f"  {word:18s} {square:10.1f} / {dof:7.1f} = {square / dof:.2f}")
            rows.append((campaign.name, report["p_value"], word, round(found["chi2"], 2),
                         round(found["dof"], 2), report["heldout"]["chi2dof_before"], where,
                         round(cpu, 1), round(memory, 3)))  # fmt: skip
    names = (
        "campaign",
        "p",
        "channel",
        "chi2",
        "dof",
        "heldout",
        "location",
        "cpu_s",
        "memory_gb",
    )
    write_results(Table(rows=rows, names=names), options.output, COMMAND)


if __name__ == "__main__":
    main()
