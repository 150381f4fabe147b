"""A full disk, a read-only one and a name that is too long: one line, and nothing half written."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

import pytest

SLOPES = "axis,slope,slope_error\nx,2.0,0.1\ny,2.4,0.1\n"

COMMANDS = {
    "show": ("show", "itl_sta3800c", "-o", "{}/profile.png"),
    "table": (
        "table", "itl_sta3800c", "--accuracy", "0.05", "--backgrounds", "0", "--depths", "95",
        "--vertices", "8", "--pixels", "5", "--workers", "1", "--no-assess", "--no-figure",
        "--charges", "20000", "-o", "{}/table.fits",
    ),
    "sweep": (
        "sweep", "itl_sta3800c", "--over", "back_bias=-50V", "--cells", "8", "--workers", "1",
        "-o", "{}/sweep.ecsv",
    ),
    "spots": (
        "spots", "itl_sta3800c", "--pixels", "5", "--sigma", "4", "--steps", "2", "--peak",
        "40000", "--spots", "1", "--workers", "1", "-o", "{}/spots",
    ),
    "fit": (
        "fit", "itl_sta3800c_60", "slopes.csv", "--free", "silicon.background_doping", "--finer",
        "0", "--draws", "0", "-o", "{}/fit",
    ),
}  # fmt: skip
"""Commands that write, with their output in a folder."""


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 200 kB in memory, and what it is mounted with; skipped where none may be."""
    disk = tmp_path / "disk"
    disk.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", disk],
        capture_output=True,
        check=False,
    )
    if made.returncode:
        pytest.skip("a file system may be mounted by the system's administrator only")
    yield disk
    subprocess.run(["umount", disk], check=True)


def said(name: str, folder: str, cwd: Path) -> str:
    """Run a command that must fail with one line, and return that line."""
    (cwd / "slopes.csv").write_text(SLOPES)
    arguments = [a.format(folder) for a in COMMANDS[name]]
    run = subprocess.run(
        [sys.executable, "-m", "bfsensor", *arguments], cwd=cwd, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert run.returncode == 1, run.stderr
    assert "Traceback" not in run.stderr
    return run.stderr.strip().splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_told_and_nothing_is_half_written(small_disk, tmp_path, name):
    with (small_disk / "others").open("wb", 0) as others, contextlib.suppress(OSError):
        while True:
            others.write(bytes(4096))
    line = said(name, "disk", tmp_path)
    assert line.startswith("bfsensor: disk/")
    assert "cannot be written: " in line
    assert line.endswith("No space left on device")
    left = [p for p in small_disk.rglob("*") if p.is_file() and p.name != "others"]
    assert left == []


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_read_only_disk_is_told(small_disk, tmp_path, name):
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    line = said(name, "disk", tmp_path)
    assert line.startswith("bfsensor: disk/")
    assert "Read-only file system" in line


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_name_that_is_too_long_is_told(tmp_path, name):
    line = said(name, "a" * 300, tmp_path)
    assert "File name too long" in line
    assert len(line) < 1000
    assert [p.name for p in tmp_path.iterdir()] == ["slopes.csv"]


def test_a_fit_refuses_its_folder_before_it_solves(tmp_path, monkeypatch):
    """Where it cannot be made: beside a file of that name."""
    from click.testing import CliRunner

    from bfsensor.cli.main import main
    from bfsensor.fit import fit

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fit, "fit_device", lambda *a, **k: pytest.fail("solved"))
    Path("slopes.csv").write_text(SLOPES)
    Path("taken").touch()
    arguments = [a.format("taken") for a in COMMANDS["fit"]]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1
    assert "taken/fit: cannot be written" in result.output
