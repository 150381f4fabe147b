"""The command line: what it writes, and one clear line for every fault."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import galsim
import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

import bfsensor
from bfsensor.cli.main import main
from bfsensor.device.device import Device, builtin_devices
from bfsensor.device.poisson_ccd import import_poisson_ccd
from bfsensor.simulate.well import full_well
from bfsensor.table import build
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import plan_table

CFG = Path(galsim.meta_data.share_dir) / "sensors" / "lsst_itl_50_8.cfg"
LEVEL = (
    "table", "itl_sta3800c", "--accuracy", "0.05", "--backgrounds", "0", "--depths", "95",
    "--vertices", "8", "--pixels", "5", "--workers", "1", "--no-assess", "--no-figure",
)  # fmt: skip
TINY = (*LEVEL, "--charges", "50000")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(main, [str(a) for a in args])


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A table of one level, and what the command printed about it."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.fits"
    result = CliRunner().invoke(main, [*TINY, "-o", str(path), "--json"])
    assert result.exit_code == 0, result.output
    return path, json.loads(result.stdout)


# -- devices -----------------------------------------------------------------------------


def test_devices(run):
    result = run("devices")
    assert result.exit_code == 0
    header, *rows = result.stdout.splitlines()
    assert header.split("  ")[0] == "name"
    assert [row.split()[0] for row in rows] == list(builtin_devices())
    assert rows[builtin_devices().index("itl_sta3800c_60")].split()[1:] == [
        "10", "100", "-8/3", "-60", "173", "published",
    ]  # fmt: skip


def test_devices_for_programs(run):
    rows = json.loads(run("devices", "--json").stdout)
    assert [row["name"] for row in rows] == list(builtin_devices())
    for row in rows:
        assert row["back bias [V]"] == Device.load(row["name"]).operating_point.back_bias


def test_device_import(run, tmp_path):
    result = run("device", "import", CFG, "-o", "itl.toml")
    assert result.exit_code == 0
    assert result.stdout == "itl.toml: lsst_itl_50_8\n"
    assert Device.load(tmp_path / "itl.toml") == import_poisson_ccd(CFG)
    (tmp_path / "itl.toml").write_text("precious")
    result = run("device", "import", CFG, "-o", "itl.toml")
    assert result.exit_code == 1
    assert result.stderr == ("bfsensor: itl.toml exists; give --overwrite to replace it\n")
    assert (tmp_path / "itl.toml").read_text() == "precious"
    assert run("device", "import", CFG, "-o", "itl.toml", "--overwrite").exit_code == 0
    assert Device.load(tmp_path / "itl.toml").name == "lsst_itl_50_8"


# -- tables ------------------------------------------------------------------------------


def test_table(tiny):
    path, summary = tiny
    table = DistortionTable.read(path)
    assert table.charges.tolist() == [50e3]
    assert table.backgrounds.tolist() == [0]
    assert table.depths.tolist() == [95]
    assert (table.vertices, table.reach) == (8, 2)
    assert Device.from_toml(table.device_text) == Device.load("itl_sta3800c")
    assert table.provenance["version"] == bfsensor.__version__
    change = table.area_changes(charge=50e3, depth=95.0)
    # The source pixel shrinks, its neighbours grow, along the column more: the signs and
    # the order are the effect; numbers are the business of the simulator's tests.
    assert change[2, 2] < 0 < change[2, 3] < change[3, 2]
    assert summary["written"] == [str(path)]
    assert summary["full_well_e"] == table.full_well
    assert summary["errors"] == dict(table.errors)
    assert os.listdir(path.parent) == [path.name]  # no levels are left


def test_table_for_galsim(run, tmp_path, tiny):
    result = run(*TINY, "--galsim", "ours")
    assert result.exit_code == 0
    assert sorted(os.listdir(tmp_path)) == ["ours.cfg", "ours.dat"]
    sensor = galsim.SiliconSensor(name=str(tmp_path / "ours"), qdist=2)
    image = galsim.ImageD(11, 11)
    image[6, 6] = 50e3
    found = sensor.calculate_pixel_areas(image, use_flux=True).array[3:8, 3:8] * 100
    expected = DistortionTable.read(tiny[0]).areas(charge=50e3, depth=95.0)
    # Positions are written to 5e-8 um, along 36 vertices: below 1e-6 um^2.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert run(*TINY, "--galsim", "ours").stderr == (
        "bfsensor: ours.cfg exists; give --overwrite to replace it\n"
    )


def test_settings_reach_the_device(run, tmp_path):
    result = run(
        *TINY, "--set", "back_bias=-70V", "--set", "temperature = 183 K", "-o", "b.fits"
    )
    assert result.exit_code == 0
    device = Device.from_toml(DistortionTable.read(tmp_path / "b.fits").device_text)
    assert device.operating_point.back_bias == -70
    assert device.operating_point.temperature == 183


def test_show(run, tmp_path, tiny):
    pytest.importorskip("matplotlib").use("Agg")
    result = run("show", tiny[0], "-o", "figure.png")
    assert result.exit_code == 0, result.output
    assert result.stdout == "figure.png\n"
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


# -- faults ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (("table", "sta3800"), ["'sta3800'", *builtin_devices(), ".toml"]),
        ((*TINY, "--set", "back_bais=-60V"), ["'back_bais'", "back_bias?"]),
        ((*TINY, "--set", "back_bias=-60"), ["operating_point", "back_bias", "'-60'", "V"]),
        ((*TINY, "--depths", "0.3"), ["0.3 um", "itl_sta3800c", "0.9 um", "100 um"]),
        ((*TINY, "--depths", "100.5"), ["100.5 um", "itl_sta3800c", "0.9 um", "100 um"]),
        ((*TINY, "--charges", "5e4,4e4"), ["charges", "50000.0, 40000.0"]),
        ((*TINY, "--pixels", "6"), ["pixels = 6", "odd", "3", "11"]),
        ((*TINY, "--accuracy", "1e-5"), ["accuracy = 1e-05", "0.005"]),
        ((*TINY, "-o", "nowhere/t.fits"), ["nowhere"]),
        ((*TINY, "--galsim", "g", "--charges", "1e4,2e4"), ["GalSim", "2 and 1"]),
        (("show", "none.fits"), ["none.fits"]),
        (("device", "import", "none.cfg"), ["none.cfg"]),
    ],
    ids=lambda v: " ".join(v[-2:]),
)
def test_faults_are_one_line_and_status_1(run, tmp_path, command, named):
    result = run(*command)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("bfsensor: ")
    assert [one for one in named if one not in line] == []
    assert result.stdout == ""
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", ["charges", "backgrounds"])
def test_beyond_the_full_well(run, kind):
    well = full_well(Device.load("itl_sta3800c"))
    result = run(*TINY, f"--{kind}", f"{1.001 * well:.8g}")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"bfsensor: {kind[:-1]} = {1.001 * well:g} e-")
    assert "itl_sta3800c" in line and f"{well:.6g} e-" in line and "2.2 V" in line


def test_existing_tables_are_kept(run, tmp_path):
    (tmp_path / "itl_sta3800c.fits").write_text("precious")  # the default name
    result = run(*TINY)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "itl_sta3800c.fits" in line and "--overwrite" in line
    assert (tmp_path / "itl_sta3800c.fits").read_text() == "precious"


def test_foreign_files_are_not_shown(run, tmp_path):
    fits.PrimaryHDU(np.ones((2, 2))).writeto(tmp_path / "image.fits")
    result = run("show", "image.fits")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("bfsensor: image.fits: ") and "SCHEMA" in line


@pytest.mark.parametrize(
    ("command", "part"),
    [
        (("table",), "Missing argument 'DEVICE'"),
        (("tabel", "itl_sta3800c"), "No such command 'tabel'"),
        (("table", "itl_sta3800c", "--colour"), "No such option"),
        ((*TINY, "--charges", "many"), "'many'"),
        ((*TINY, "--set", "back_bias"), "KEY=VALUE"),
        ((*TINY, "--vertices", "few"), "'few' is not a valid integer"),
        ((*TINY, "--workers", "0"), "Invalid value for '--workers'"),
    ],
    ids=lambda v: v if isinstance(v, str) else None,
)
def test_wrong_usage_is_status_2(run, tmp_path, command, part):
    result = run(*command)
    assert result.exit_code == 2
    assert "Usage: " in result.stderr
    assert part in result.stderr
    assert os.listdir(tmp_path) == []


def test_a_process_fails_in_the_same_way():
    result = subprocess.run(
        [sys.executable, "-m", "bfsensor", "show", "none.fits"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert result.returncode == 1
    assert result.stderr == "bfsensor: none.fits: no such file\n"
    assert result.stdout == ""


# -- interruption ------------------------------------------------------------------------


def same_but_for_costs(table):
    """A table without what differs from run to run: the command line and its CPU time."""
    kept = {
        k: v for k, v in table.provenance.items() if k not in ("command", "levels cpu [s]")
    }
    assert len(kept) == len(table.provenance) - 2
    return dataclasses.replace(table, provenance=kept)


def test_a_killed_run_goes_on_and_gives_the_same_bits(run, tmp_path, monkeypatch):
    command = (*LEVEL, "--charges", "0,20000,50000,90000")
    levels = tmp_path / "killed.fits.levels"
    process = subprocess.Popen(
        [sys.executable, "-m", "bfsensor", *command, "-o", "killed.fits"],
        cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 300
        # Level 0 costs nothing; the one of 20000 e- is the first that is solved.
        while not list(levels.glob("*/level_20000_0.npz")):
            assert process.poll() is None, "ended before it could be killed"
            assert time.monotonic() < deadline
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL
    assert not (tmp_path / "killed.fits").exists()
    finished = {float(p.stem.split("_")[1]) for p in levels.glob("*/level_*.npz")}
    assert {0.0, 20e3} <= finished < {0.0, 20e3, 50e3, 90e3}

    solved = []
    original = build.solve_level

    def counting(plan, charge, background):
        solved.append(charge)
        return original(plan, charge, background)

    monkeypatch.setattr(build, "solve_level", counting)
    assert run(*command, "-o", "killed.fits").exit_code == 0
    assert set(solved) == {0.0, 20e3, 50e3, 90e3} - finished
    assert not levels.exists()
    solved.clear()
    assert run(*command, "-o", "whole.fits").exit_code == 0
    assert solved == [0.0, 20e3, 50e3, 90e3]
    killed = DistortionTable.read(tmp_path / "killed.fits")
    whole = DistortionTable.read(tmp_path / "whole.fits")
    assert same_but_for_costs(killed) == same_but_for_costs(whole)
    for name in ("corners", "horizontal", "vertical"):
        assert getattr(killed, name).tobytes() == getattr(whole, name).tobytes()


def test_a_damaged_level_is_refused_by_name(run, tmp_path):
    """Half a level cannot exist by an interruption; one damaged otherwise is named."""
    folder = tmp_path / "t.fits.levels"
    plan = plan_table(
        Device.load("itl_sta3800c"), charges=(50e3,), backgrounds=(0.0,), depths=(95.0,),
        vertices=8, pixels=5, accuracy=0.05,
    )  # fmt: skip
    path = folder / plan.key / "level_50000_0.npz"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"PK\x03\x04 half")
    result = run(*TINY, "-o", "t.fits")
    assert result.exit_code == 1
    last = result.stderr.splitlines()[-1]
    assert last.startswith(f"bfsensor: {path.relative_to(tmp_path)}: ")


@pytest.mark.parametrize(
    "command", [["devices"], ["table"], ["device", "import"], ["show"]]
)
def test_help_shows_an_example_on_lines_of_its_own(command):
    text = CliRunner().invoke(main, [*command, "--help"]).output
    assert "\\b" not in text
    lines = [line.strip() for line in text.splitlines()]
    start = next(i for i, line in enumerate(lines) if line in ("Example:", "Examples:"))
    assert lines[start + 1].startswith(f"bfsensor {' '.join(command)}")
