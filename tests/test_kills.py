"""``kill -9`` at random moments of every long command: the same results, no orphans, nothing left over.

``python -m pytest -n 0 -m slow -s tests/test_kills.py`` prints a line for each command.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from bfsensor.sweeps.device_sweep import DeviceSweep
from bfsensor.table.table import DistortionTable
from tests.virtual import make_effect, write_campaign

KILLS = 20
"""Kills of each command.  Chosen: a moment that loses a twentieth of all runs is met in 64 % of the
tests, with 40 in 87 %."""

ORPHANS_END = 10.0
"""Seconds in which processes of a killed command must have ended: what the commands promise."""

MARK, WHOLE = "BFSENSOR_KILLED_RUN", "whole"


def processes(mark: str) -> list[int]:
    """Numbers of running processes whose environment holds a mark."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state = (path / "stat").read_text().rpartition(")")[2].split()[0]
            if (
                state != "Z"
                and f"{MARK}={mark}".encode() in (path / "environ").read_bytes()
            ):
                found.append(int(path.name))
    return found


def start(arguments: list[str], folder: Path, mark: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, *arguments], cwd=folder, env={**os.environ, MARK: mark},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL if mark != WHOLE else None,
    )  # fmt: skip


def finish(arguments: list[str], folder: Path) -> float:
    """Run a command to its end, and return its seconds."""
    began = time.monotonic()
    assert start(arguments, folder, WHOLE).wait() == 0
    return time.monotonic() - began


def files(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def report_of(path: Path, folder: Path) -> dict[str, Any]:
    """A report without its costs, and without the folder that the campaign lies in."""
    report = json.loads(path.read_text().replace(str(folder), ""))
    return {k: v for k, v in report.items() if k != "provenance"}


def of_table(folder: Path) -> Any:
    table = DistortionTable.read(folder / "out.fits")
    costs = ("command", "levels cpu [s]")
    held = {f.name: getattr(table, f.name) for f in dataclasses.fields(table)}
    held["provenance"] = {k: v for k, v in table.provenance.items() if k not in costs}
    return {
        k: v.tobytes() if isinstance(v, np.ndarray) else str(v) for k, v in held.items()
    }


def of_sweep(folder: Path) -> Any:
    rows = DeviceSweep.read(folder / "out.ecsv").rows
    return {
        n: np.asarray(rows[n]).tolist() for n in rows.colnames if n not in ("cpu", "reason")
    }


def of_spots(folder: Path) -> Any:
    found = {}
    for path in sorted((folder / "out").glob("spot_*.fits")):
        with fits.open(path) as units:
            images = [u.data for u in units if isinstance(u.data, np.ndarray)]
            found[path.name] = [i.tobytes() for i in images if i.dtype.names is None]
    return found


def of_images(folder: Path) -> Any:
    return {
        p.name: fits.getdata(p).tobytes() for p in sorted((folder / "out").glob("*.fits"))
    }


def of_fit(folder: Path) -> Any:
    found = json.loads((folder / "out" / "fit.json").read_text())
    return {k: v for k, v in found.items() if k not in ("provenance", "cpu", "seconds")}


def of_diagnosis(folder: Path) -> Any:
    return report_of(folder / "out" / "report.json", folder)


def of_reports(folder: Path) -> Any:
    return {
        p.parent.name: report_of(p, folder)
        for p in sorted((folder / "out").glob("*/report.json"))
    }


@dataclasses.dataclass(frozen=True)
class Killed:
    """A long command, what it writes, and how its results are read."""

    arguments: tuple[str, ...]
    output: str
    results: Callable[[Path], Any]


COMMANDS = {
    "table": Killed(
        (
            "-m", "bfsensor", "table", "itl_sta3800c", "--accuracy", "0.05", "--backgrounds", "0",
            "--depths", "95", "--vertices", "8", "--pixels", "5", "--workers", "2", "--no-assess",
            "--no-figure", "--charges", "0,20000,50000,90000", "-o", "out.fits",
        ),
        "out.fits",
        of_table,
    ),
    "sweep": Killed(
        (
            "-m", "bfsensor", "sweep", "itl_sta3800c", "--over", "back_bias=-50V,-60V,-70V",
            "--cells", "8", "--workers", "2", "-o", "out.ecsv",
        ),
        "out.ecsv",
        of_sweep,
    ),
    "spots": Killed(
        (
            "-m", "bfsensor", "spots", "itl_sta3800c", "--pixels", "5", "--sigma", "4", "--steps",
            "2", "--peak", "40000", "--spots", "3", "--workers", "2", "-o", "out",
        ),
        "out/spot_*_0002.fits",
        of_spots,
    ),
    "fit": Killed(
        (
            "-m", "bfsensor", "fit", "itl_sta3800c_60", "slopes.csv", "--free",
            "silicon.background_doping", "--finer", "0", "--draws", "0", "-o", "out",
        ),
        "out/fit.json",
        of_fit,
    ),
    "correct": Killed(
        (
            "-m", "bfsensor", "correct", *(f"image_{n}.fits" for n in range(6)), "--table",
            "itl_sta3800c", "--band", "r", "--workers", "2", "-o", "out",
        ),
        "out/image_5.fits",
        of_images,
    ),
    "diagnose": Killed(
        ("-m", "bfsensor", "diagnose", "campaigns/one", "-o", "out"),
        "out/report.json",
        of_diagnosis,
    ),
    "concealed run": Killed(
        (
            "-m", "validation.concealed", "run", "campaigns", "-o", "out", "--command",
            f"{sys.executable} -m bfsensor diagnose --locate-only",
        ),
        "out/two/report.json",
        of_reports,
    ),
}  # fmt: skip
"""Long commands, small enough to end in some ten seconds."""


def prepare(name: str, folder: Path) -> Path:
    """A folder with the inputs of a command."""
    folder.mkdir()
    if name == "fit":
        rows = "axis,slope,slope_error\nx,2.0,0.1\ny,2.4,0.1\n"
        (folder / "slopes.csv").write_text(rows)
    for n in range(6) if name == "correct" else ():
        image = np.random.default_rng(n).uniform(0, 9e4, (700, 700)).astype(np.float32)
        header = fits.Header({"BUNIT": "electron"})
        fits.writeto(folder / f"image_{n}.fits", image, header)
    if name in ("diagnose", "concealed run"):
        effect = make_effect("cti_serial", {"cti": 3e-6})
        for one in ("one",) if name == "diagnose" else ("one", "two"):
            write_campaign(
                folder / "campaigns" / one, seed=7301, size="T", effects=[effect],
                truth_folder=folder / "truth",
            )  # fmt: skip
    return folder


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are listed in /proc")
@pytest.mark.parametrize("name", COMMANDS)
def test_kills_at_random_moments(tmp_path, name):
    """Each kill is followed by the same command; where it has finished, another run begins."""
    arguments, results = list(COMMANDS[name].arguments), COMMANDS[name].results
    whole = prepare(name, tmp_path / "whole")
    inputs = files(whole)
    seconds = finish(arguments, whole)
    expected, written = results(whole), files(whole)
    moments, runs, lates, slowest = random.Random(20), 0, 0, 0.0
    folder = prepare(name, tmp_path / "cut0")
    assert files(folder) == inputs
    for n in range(KILLS):
        mark = f"{name}-{n}-{os.getpid()}"
        process = start(arguments, folder, mark)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=moments.uniform(0.2, seconds))
        process.send_signal(signal.SIGKILL)
        process.wait()
        killed = time.monotonic()
        while processes(mark) and time.monotonic() - killed < ORPHANS_END:
            time.sleep(0.05)
        assert not processes(mark)
        slowest = max(slowest, time.monotonic() - killed)
        assert process.returncode in (-signal.SIGKILL, 0)
        last = n == KILLS - 1
        # Killed after its output was written: only what helps to go on may be there beside it.
        late = process.returncode != 0 and any(folder.glob(COMMANDS[name].output))
        if last and process.returncode != 0 and not late:
            finish(arguments, folder)
        if process.returncode == 0 or late or last:
            assert results(folder) == expected
            if late:
                lates += 1
            else:
                assert files(folder) == written
            runs += 1
            folder = prepare(name, tmp_path / f"cut{runs}")
    print(
        f"{name}: {KILLS} kills in {runs} runs of {seconds:.1f} s, {lates} of them after the output, "
        f"processes gone in {slowest:.1f} s"
    )
